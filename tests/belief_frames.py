"""Frames for belief modules, and the two ways to run over them; see suites.py."""

import torch
from filter_problems import assert_equal
from suite_environments import ACTION, OBS
from tensordict import TensorDict
from torchrl.envs import Compose
from torchrl.modules import set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module


class BeliefFrames:
    """What the suites of belief modules share."""

    observation: str = "observation"  # where the modules read what arrived
    # How far steps and sequences may differ, as a share of the largest entry.
    tolerance32: float = 1e-5
    tolerance64: float = 1e-10

    @property
    def frame_keys(self):
        return (self.observation, "observed", "previous_action", "is_init")

    def make_frames(self, shape, dtype=torch.float32, seed=0, obs=OBS, action=ACTION):
        """Return what the environment writes, nowhere an episode start."""
        g = torch.Generator().manual_seed(seed)
        observed = torch.rand(*shape, obs, generator=g) < 0.6
        observation = torch.randn(*shape, obs, generator=g, dtype=dtype)
        data = {self.observation: torch.where(observed, observation, 0.0), "observed": observed}
        data["previous_action"] = torch.randn(*shape, action, generator=g, dtype=dtype)
        data["is_init"] = torch.zeros(*shape, 1, dtype=torch.bool)
        return TensorDict(data, shape)

    def any_module(self):
        raise NotImplementedError(f"{type(self).__name__} must say in `any_module` what is tested")

    def primers(self, module):
        """Return the specs of the recurrent state; none where the module has no memory."""
        found = get_primers_from_module(module, warn=False)
        parts = [] if found is None else found if isinstance(found, Compose) else [found]
        return {key: spec for part in parts for key, spec in part.primers.items(True, True)}

    def state_keys(self, module):
        return list(self.primers(module))

    def some_state(self, module, shape, seed=1):
        """Return a recurrent state in mid-episode: what the module wrote after two steps."""
        dtype = next(module.parameters()).dtype
        frames = self.make_frames((*shape, 2), dtype, seed)
        frames["is_init"][..., 0, :] = True
        with torch.no_grad():
            return self.one_by_one(module, frames, None)["next"][..., -1].select(
                *self.state_keys(module)
            )

    def one_by_one(self, module, frames, start):
        """Return what a collector would: the stored state at every step, zeros at a start."""
        keys = self.state_keys(module)
        primers = self.primers(module)
        batch = frames.shape[:-1]
        zeros = TensorDict({k: primers[k].expand(*batch, *primers[k].shape).zero() for k in keys})
        carried = zeros if start is None else start
        steps = []
        for t in range(frames.shape[-1]):
            step = frames[..., t].clone()
            for key in keys:
                first = step["is_init"].reshape(*batch, *([1] * (primers[key].ndim)))
                step.set(key, torch.where(first, zeros[key], carried[key]))
            with set_recurrent_mode(False):
                module(step)
            carried = step.get("next", None)  # a module without memory writes none
            steps.append(step)
        return torch.stack(steps, len(batch))

    def as_sequence(self, module, rollout):
        """Run over time from what a rollout stores, with what the module wrote left out."""
        with set_recurrent_mode(True):
            return module(rollout.select(*self.frame_keys, *self.state_keys(module)))

    def written(self, module):
        return [k for k in module.out_keys if not (isinstance(k, tuple) and k[0] == "next")]

    def assert_same(self, module, received, expected):
        for key in self.written(module):
            dtype = expected[key].dtype
            limit = self.tolerance64 if dtype == torch.float64 else self.tolerance32
            # The largest entry sets the scale: beliefs of raw sensors may be far from 1.
            scale = max(1.0, expected[key].abs().max().item())
            assert_equal(received[key], expected[key], limit, str(key), scale)

    def test_every_out_key_is_written_no_other_and_no_input_is_changed(self):
        module = self.any_module()
        frames = self.make_frames((3, 4))
        frames["is_init"][:, 0] = frames["is_init"][1, 2] = True
        rollout = self.one_by_one(module, frames, None)
        before, sequence = rollout.clone(), self.as_sequence(module, rollout)
        for out in (rollout, sequence):
            names = {*self.frame_keys, *self.state_keys(module), *module.out_keys}
            assert set(out.keys(True, True)) == names
        for key in module.out_keys:
            assert sequence[key].shape == rollout[key].shape, key
            assert sequence[key].dtype == rollout[key].dtype, key
        for key in module.in_keys:
            assert torch.equal(sequence[key], before[key]), key
            assert torch.equal(rollout[key], before[key]), key
