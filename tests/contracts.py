"""Duties that every transform, loss and belief module of the package must meet.

A test file subclasses a contract, fills in its hooks and inherits its tests. The classes here are
not collected by themselves: their names do not begin with "Test".

`TransformContract` is TorchRL's own list for a transform test (single, serial-trans,
parallel-trans, trans-serial, trans-parallel, no env, compose, env, model, replay buffer, inverse),
and on top: any leading batch shape, float64 kept, the first observation of an episode treated like
every other, partial resets that leave the other rows alone, the global generator untouched, a
state that survives `torch.save` with `weights_only=True`, copies without a parent.

`LossContract` is TorchRL's list for a loss: keys, dispatch, reduction, parameters held once, files,
copies, dtypes and devices.

`BeliefModuleContract` is what `GRUModule` does in a TorchRL pipeline (one step or whole sequences,
primer, collector, batched environments, compile, export), and this package's rule for what a
recurrent module starts from: the beginning where `is_init & (age == 0)`, else the stored state.
"""

from __future__ import annotations

import copy
import io
import pickle
import warnings
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    Categorical,
    Composite,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    EnvBase,
    GymEnv,
    InitTracker,
    ParallelEnv,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives.common import LossModule

from torchrl_drbpn import GymnasiumBatchEnv, ObservationMissingness, PreviousAction

__all__ = [
    "ACTION",
    "OBS",
    "BeliefModuleContract",
    "LossContract",
    "StaircaseEnv",
    "TransformContract",
    "belief_env",
    "gym_env",
    "parallel_env",
    "saved",
    "with_belief_entries",
]

OBS, ACTION = 5, 2


# ------------------------------------------------------------------------------------- environments
class StaircaseEnv(EnvBase):
    """A batched environment whose observation is known: 100 b + t + i/10 in row b, component i.

    Row b terminates at step `horizon + b`, so that the rows of a batch are reset at different
    times. The reward is 1 a step. Actions change nothing.
    """

    def __init__(
        self, batch: int = 3, horizon: int = 3, obs: int = OBS, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__(batch_size=[batch], device="cpu")
        shape = (batch,)
        self.observation_spec = Composite(
            observation=Bounded(-1e4, 1e4, shape=(*shape, obs), dtype=dtype), shape=shape
        )
        self.action_spec = Unbounded(shape=(*shape, ACTION), dtype=dtype)
        self.reward_spec = Unbounded(shape=(*shape, 1))
        done = Categorical(2, shape=(*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(done=done, terminated=done.clone(), shape=shape)
        self.last = horizon + torch.arange(batch)
        self.time = torch.zeros(batch, dtype=torch.int64)
        self.ramp = torch.arange(obs, dtype=dtype) / 10 + 100.0 * torch.arange(batch)[:, None]

    def _observe(self) -> TensorDict:
        observation = self.ramp + self.time[:, None]
        done = (self.time >= self.last)[:, None]
        return TensorDict(
            {
                "observation": observation.to(self.ramp.dtype),
                "done": done,
                "terminated": done.clone(),
            },
            self.batch_size,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        del kwargs
        rows = None if tensordict is None else tensordict.get("_reset", None)
        if rows is None:
            self.time = torch.zeros_like(self.time)
        else:
            self.time = self.time.masked_fill(rows.reshape(-1), 0)
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        del tensordict
        self.time = self.time + 1
        return self._observe().set("reward", torch.ones(*self.batch_size, 1))

    def _set_seed(self, seed: int | None) -> None:
        del seed


def gym_env(name: str = "InvertedPendulum-v5") -> EnvBase:
    """Return a Gymnasium environment in float32, one process, batch size ()."""
    return TransformedEnv(GymEnv(name), DoubleToFloat())


def parallel_env(workers: int, factory: Any) -> ParallelEnv:
    """Return a ParallelEnv whose processes start quickly; `factory` must be picklable."""
    return ParallelEnv(workers, factory, mp_start_method="fork")


def with_transform(make_env: Any, make_transform: Any) -> EnvBase:
    """Return `make_env()` with `make_transform()` appended."""
    return make_env().append_transform(make_transform())


def _extend_and_sample(buffer: TensorDictReplayBuffer, data: TensorDictBase) -> None:
    buffer.extend(data)
    buffer.sample()


def saved(state: Any) -> Any:
    """Return `state` after a trip through a file that is read without running code."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


# --------------------------------------------------------------------------------------- transforms
class TransformContract:
    """Duties of a transform. Hooks to fill in: `make_transform` and `check_output`.

    Attributes:
        offline: whether the transform works on a replay buffer and in a model ("works") or must
            refuse there with NotImplementedError ("raises").
        refused_in_workers: None, or the text that the error must hold when an environment with the
            transform is put into SerialEnv or ParallelEnv workers.
        keeps_float64: the keys that must be float64 where the observation is.
    """

    offline: str = "raises"
    refused_in_workers: str | None = None
    keeps_float64: tuple[Any, ...] = ("observation",)

    # --- hooks
    def make_transform(self) -> Transform:
        """Return a fresh transform, equal to every other that this method returns."""
        raise NotImplementedError

    def check_output(self, before: TensorDictBase, after: TensorDictBase) -> None:
        """Assert that `after` is what the transform makes of an observation.

        `before` is the data that went in where that is known (it holds "observation"), and empty in
        the tests with a real simulator.
        """
        raise NotImplementedError

    def make_env(self) -> EnvBase:
        """Return the simulator, a TransformedEnv, without the transform."""
        return gym_env()

    def make_batched_env(self) -> EnvBase:
        """Return a batched environment whose rows end at different steps."""
        return TransformedEnv(StaircaseEnv(), Compose())

    def make_data(self, batch: tuple[int, ...], dtype: torch.dtype = torch.float32) -> TensorDict:
        """Return what an environment's step would give to the transform."""
        generator = torch.Generator().manual_seed(1)
        shape = torch.Size(batch)
        return TensorDict(
            {
                "observation": torch.randn(*shape, OBS, generator=generator, dtype=dtype),
                "reward": torch.ones(*shape, 1, dtype=dtype),
                "done": torch.zeros(*shape, 1, dtype=torch.bool),
                "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
            },
            shape,
        )

    def make_root(self, batch: tuple[int, ...], dtype: torch.dtype = torch.float32) -> TensorDict:
        """Return the data at the step before, with the action that led to `make_data`."""
        generator = torch.Generator().manual_seed(2)
        data = self.make_data(batch, dtype)
        action = torch.randn(*batch, ACTION, generator=generator, dtype=dtype)
        data.set("action", action)
        return self.make_transform()._reset(data.empty(), data)

    # --- TorchRL's list
    def test_single_trans_env_check(self):
        check_env_specs(with_transform(self.make_env, self.make_transform))
        check_env_specs(
            with_transform(self.make_batched_env, self.make_transform),
            break_when_any_done="both",
        )

    def test_serial_trans_env_check(self):
        factory = partial(with_transform, self.make_env, self.make_transform)
        if self.refused_in_workers is not None:
            with pytest.raises(Exception, match=self.refused_in_workers):
                SerialEnv(2, factory).rollout(2)
            return
        env = SerialEnv(2, factory)
        check_env_specs(env)
        env.close()

    def test_parallel_trans_env_check(self):
        factory = partial(with_transform, self.make_env, self.make_transform)
        if self.refused_in_workers is not None:
            with pytest.raises(Exception, match=self.refused_in_workers):
                parallel_env(2, factory).rollout(2)
            return
        env = parallel_env(2, factory)
        try:
            check_env_specs(env)
        finally:
            env.close(raise_if_closed=False)

    def test_trans_serial_env_check(self):
        env = TransformedEnv(SerialEnv(2, self.make_env), self.make_transform())
        check_env_specs(env)
        env.close()

    def test_trans_parallel_env_check(self):
        env = TransformedEnv(parallel_env(2, self.make_env), self.make_transform())
        try:
            check_env_specs(env)
        finally:
            env.close(raise_if_closed=False)

    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_transform_no_env(self, batch):
        transform, data = self.make_transform(), self.make_data(batch)
        first = transform._reset(data.empty(), data.clone())
        assert first.batch_size == data.batch_size
        self.check_output(data, first)
        transform = self.make_transform()
        after = transform._step(self.make_root(batch), data.clone())
        assert after.batch_size == data.batch_size
        self.check_output(data, after)

    @pytest.mark.parametrize("batch", [(), (3,)])
    def test_transform_compose(self, batch):
        data, root = self.make_data(batch), self.make_root(batch)
        alone = self.make_transform()._step(root, data.clone())
        composed = Compose(Compose(self.make_transform()))._step(root, data.clone())
        self.check_output(data, composed)
        assert set(alone.keys(True, True)) == set(composed.keys(True, True))
        for key in alone.keys(True, True):
            torch.testing.assert_close(composed[key], alone[key], rtol=0, atol=0)

    def test_transform_env(self):
        env = with_transform(self.make_env, self.make_transform)
        nothing = TensorDict({}, [])
        reset = env.reset()
        self.check_output(nothing, reset)
        stepped = env.rand_step(reset)
        self.check_output(nothing, stepped["next"])
        specs = env.full_observation_spec
        for key, leaf in specs.items(True, True):
            assert stepped["next"][key].dtype == leaf.dtype
            assert leaf.is_in(stepped["next"][key])
            assert leaf.is_in(reset[key])

    def test_transform_model(self):
        transform, data = self.make_transform(), self.make_data((3,))
        module = TensorDictModule(nn.Linear(OBS, 1), ["observation"], ["value"])
        if self.offline == "raises":
            with pytest.raises(NotImplementedError, match=type(transform).__name__):
                nn.Sequential(transform, module)(data)
            return
        after = nn.Sequential(transform, module)(data.clone())
        self.check_output(data, after)
        assert after["value"].shape == (3, 1)

    def test_transform_rb(self):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=4)
        transform, data = self.make_transform(), self.make_data((6,))
        buffer.append_transform(transform)
        if self.offline == "raises":
            with pytest.raises(NotImplementedError, match=type(transform).__name__):
                _extend_and_sample(buffer, data)
            return
        buffer.extend(data)
        sample = buffer.sample()
        self.check_output(data[sample["index"]], sample)

    def test_transform_inverse(self):
        data = self.make_data((3,))
        after = self.make_transform().inv(data.clone())
        for key, value in data.items(True, True):
            assert torch.equal(after[key], value)

    # --- this package's list
    def test_float64_is_kept(self):
        after = self.make_transform()._step(
            self.make_root((3,), torch.float64), self.make_data((3,), torch.float64)
        )
        for key in self.keeps_float64:
            assert after[key].dtype == torch.float64

    def test_a_partial_reset_leaves_the_other_rows_alone(self):
        env = with_transform(self.make_batched_env, self.make_transform)
        data = env.rand_step(env.reset())
        root = data["next"].exclude("reward")
        rows = torch.tensor([True, False, True])
        after = env.reset(root.clone().set("_reset", rows[:, None]))
        for key in env.full_observation_spec.keys(True, True):
            assert torch.equal(after[key][1], root[key][1]), key
        self.check_output(TensorDict({}, []), after)

    def test_rollouts_pass_over_the_ends_of_episodes(self):
        env = with_transform(self.make_batched_env, self.make_transform)
        data = env.rollout(12, break_when_any_done=False)
        assert data["next", "done"].any()
        assert data.shape == (3, 12)
        # what the policy reads at t + 1 is what arrived at t, except where an episode began
        going_on = ~data["next", "done"][:, :-1, 0]
        for key in env.full_observation_spec.keys(True, True):
            after = data[key][:, 1:][going_on]
            assert torch.equal(after, data.get(("next", key))[:, :-1][going_on]), key

    def test_the_global_generator_is_untouched(self):
        data, root = self.make_data((3,)), self.make_root((3,))
        torch.manual_seed(0)
        state = torch.get_rng_state()
        transform = self.make_transform()
        transform._reset(data.empty(), data.clone())
        transform._step(root, data.clone())
        assert torch.equal(torch.get_rng_state(), state)

    def test_a_saved_state_goes_on_as_if_never_stopped(self):
        data, root = self.make_data((3,)), self.make_root((3,))
        first, second = self.make_transform(), self.make_transform()
        first._reset(data.empty(), data.clone())
        first._step(root, data.clone())
        second.load_state_dict(saved(first.state_dict()))
        expected, received = first._step(root, data.clone()), second._step(root, data.clone())
        for key in expected.keys(True, True):
            assert torch.equal(received[key], expected[key]), key

    @pytest.mark.parametrize("how", ["clone", "deepcopy", "pickle"])
    def test_a_copy_goes_its_own_way_from_the_same_state(self, how):
        data, root = self.make_data((3,)), self.make_root((3,))
        first = self.make_transform()
        first._step(root, data.clone())
        if how == "clone":
            second = first.clone()
        elif how == "deepcopy":
            second = copy.deepcopy(first)
        else:
            second = pickle.loads(pickle.dumps(first))
        assert second.container is None
        # stepping the copy first must not advance the original
        received, expected = second._step(root, data.clone()), first._step(root, data.clone())
        for key in expected.keys(True, True):
            assert torch.equal(received[key], expected[key]), key

    def test_an_absent_observation_is_named(self):
        transform = self.make_transform()
        if not transform.in_keys:
            pytest.skip("reads nothing")
        with pytest.raises(KeyError, match=type(transform).__name__):
            transform._step(self.make_root((3,)), TensorDict({}, [3]))


# ------------------------------------------------------------------------------------------- losses
class LossContract:
    """Duties of a loss: what a TorchRL LossModule promises.

    Attributes:
        has_networks: whether the loss holds parameters.
        reductions: the values of `reduction` that the constructor takes; empty where the held
            losses decide.
    """

    has_networks: bool = True
    reductions: tuple[str, ...] = ()

    # --- hooks
    def make_loss(self, **kwargs: Any) -> LossModule:
        """Return a loss, equal to every other that this method returns."""
        raise NotImplementedError

    def make_loss_data(self, dtype: torch.dtype = torch.float32) -> TensorDict:
        """Return a minibatch, `[batch, time]`."""
        raise NotImplementedError

    # --- helpers
    def _total(self, out: TensorDictBase) -> torch.Tensor:
        terms = [v for k, v in out.items() if isinstance(k, str) and k.startswith("loss")]
        assert terms
        return torch.stack([term.sum() for term in terms]).sum()

    def _assert_equal(self, received: TensorDictBase, expected: TensorDictBase) -> None:
        assert set(received.keys(True, True)) == set(expected.keys(True, True))
        for key in expected.keys(True, True):
            torch.testing.assert_close(received[key], expected[key])

    # --- keys
    def test_an_unknown_key_is_refused(self):
        with pytest.raises(ValueError, match="unknown_key"):
            self.make_loss().set_keys(unknown_key="other")

    def test_every_key_can_be_renamed_and_restored(self):
        defaults = self.make_loss().default_keys()
        names = list(vars(defaults))
        for name in names:
            loss = self.make_loss()
            loss.set_keys(**{name: "renamed"})
            assert getattr(loss.tensor_keys, name) == "renamed"
            for other in names:
                if other != name:
                    assert getattr(loss.tensor_keys, other) == getattr(defaults, other)
            loss.set_keys(**{name: None})
            assert getattr(loss.tensor_keys, name) == getattr(defaults, name)
        loss = self.make_loss()
        loss.set_keys(**dict.fromkeys(names, "renamed"))
        assert all(getattr(loss.tensor_keys, name) == "renamed" for name in names)

    def test_in_keys_are_all_that_is_read(self):
        loss, data = self.make_loss(), self.make_loss_data()
        self._assert_equal(loss(data.select(*loss.in_keys, strict=False)), loss(data))

    def test_out_keys_are_written_and_hold_every_term_to_be_summed(self):
        loss = self.make_loss()
        written = set(loss(self.make_loss_data()).keys(True, True))
        assert set(loss.out_keys) <= written
        assert {key for key in written if key.startswith("loss")} <= set(loss.out_keys)

    def test_dispatch_takes_tensors_by_name(self):
        loss, data = self.make_loss(), self.make_loss_data()
        expected = loss(data)
        kwargs = {}
        for key in loss.in_keys:
            value = data.get(key, None)
            if value is not None:
                kwargs[key if isinstance(key, str) else "_".join(key)] = value
        received = loss(**kwargs)
        assert len(received) == len(loss.out_keys)
        for key, value in zip(loss.out_keys, received, strict=True):
            torch.testing.assert_close(value, expected[key])

    def test_the_input_is_left_as_it_was(self):
        loss, data = self.make_loss(), self.make_loss_data()
        before = data.clone()
        loss(data)
        assert set(data.keys(True, True)) == set(before.keys(True, True))
        for key in before.keys(True, True):
            assert torch.equal(data[key], before[key]), key

    def test_every_reduction_has_its_shape(self):
        for reduction in self.reductions:
            data = self.make_loss_data()
            out = self.make_loss(reduction=reduction)(data)
            for key, value in out.items():
                if key.startswith("loss"):
                    assert value.shape == (data.shape if reduction == "none" else ()), key

    # --- parameters
    def test_parameters_are_there_once_and_all_get_a_gradient(self):
        loss = self.make_loss()
        parameters = dict(loss.named_parameters())
        assert bool(parameters) == self.has_networks
        assert len({id(p) for p in parameters.values()}) == len(parameters)
        if not self.has_networks:
            return
        self._total(loss(self.make_loss_data())).backward()
        for name, parameter in parameters.items():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name

    def test_the_state_survives_a_file(self):
        first, second, data = self.make_loss(), self.make_loss(), self.make_loss_data()
        with torch.no_grad():
            for parameter in first.parameters():
                parameter += 0.05
        second.load_state_dict(saved(first.state_dict()))
        self._assert_equal(second(data), first(data))

    def test_a_deepcopy_computes_the_same_and_shares_nothing(self):
        first, data = self.make_loss(), self.make_loss_data()
        expected = first(data)
        second = copy.deepcopy(first)
        theirs = {id(p) for p in first.parameters()}
        assert not theirs & {id(p) for p in second.parameters()}
        with torch.no_grad():
            for parameter in first.parameters():
                parameter.zero_()
        self._assert_equal(second(data), expected)

    def test_it_moves_to_float64(self):
        loss = self.make_loss().to(torch.float64)
        assert all(p.dtype == torch.float64 for p in loss.parameters())
        out = loss(self.make_loss_data(torch.float64))
        assert self._total(out).dtype == torch.float64

    @pytest.mark.gpu
    @pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    def test_it_moves_to_a_gpu(self):
        loss, data = self.make_loss(), self.make_loss_data()
        expected = self._total(loss(data)).item()
        loss = loss.to("cuda")
        total = self._total(loss(data.to("cuda")))
        assert total.device.type == "cuda"
        assert total.item() == pytest.approx(expected, rel=1e-3, abs=1e-4)

    def test_parameters_can_be_reset(self):
        loss = self.make_loss()
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter += 1000
        before = {name: p.clone() for name, p in loss.named_parameters()}
        loss.reset_parameters_recursive()
        for name, parameter in loss.named_parameters():
            assert (parameter != before[name]).any(), name

    def test_the_global_generator_is_untouched(self):
        loss, data = self.make_loss(), self.make_loss_data()
        state = torch.get_rng_state()
        loss(data)
        assert torch.equal(torch.get_rng_state(), state)


# ----------------------------------------------------------------------------------- belief modules
def belief_env(primer: Transform | None = None, name: str = "InvertedPendulum-v5") -> EnvBase:
    """Return an environment that writes what every belief module reads, batch size ()."""
    env = TransformedEnv(GymEnv(name), Compose())
    return with_belief_entries(env, primer)


def actions_in_float64() -> Transform:
    """Return the transform that lets a float64 policy act in a simulator of float32 actions."""
    return DTypeCastTransform(torch.float32, torch.float64, in_keys=[], in_keys_inv=["action"])


def with_belief_entries(
    env: TransformedEnv, primer: Transform | None = None, *, to_float32: bool = True
) -> TransformedEnv:
    """Append what every belief module reads; half of the entries are missing.

    In float64 the actions are float64 too, as the policy's are.
    """
    for transform in (
        DoubleToFloat() if to_float32 else actions_in_float64(),
        PreviousAction(),
        ObservationMissingness("mcar", 0.5, always_observed=0.0),
        InitTracker(),
        primer,
    ):
        if transform is not None:
            env.append_transform(transform)
    return env


class BeliefModuleContract:
    """Duties of a belief module: what `GRUModule` does in a TorchRL pipeline, and the age rule.

    `is_init & (age == 0)` starts from the module's own beginning; `is_init` with an older age takes
    the stored state; without `is_init` the state is carried on.

    Attributes:
        age_key: the root entry that counts updates since the reset.
        tolerance32: how far one step at a time and whole sequences may differ in float32, as a
            share of the largest entry.
        tolerance64: the same in float64.
    """

    age_key: Any = ("recurrent", "age")
    tolerance32: float = 1e-5
    tolerance64: float = 1e-10

    # --- hooks
    def make_module(
        self, obs: int = OBS, action: int = ACTION, dtype: torch.dtype | None = None, **kwargs: Any
    ) -> TensorDictModuleBase:
        """Return a module, equal to every other made with the same arguments."""
        raise NotImplementedError

    def differentiable(self, out: TensorDictBase) -> torch.Tensor:
        """Return a number that depends on everything the module learns from."""
        return out["features"].square().mean()

    # --- helpers
    def make_frames(
        self, shape: tuple[int, ...], dtype: torch.dtype = torch.float32, seed: int = 0
    ) -> TensorDict:
        """Return what the environment writes, nowhere an episode start."""
        g = torch.Generator().manual_seed(seed)
        observed = torch.rand(*shape, OBS, generator=g) < 0.6
        observation = torch.randn(*shape, OBS, generator=g, dtype=dtype)
        return TensorDict(
            {
                "observation": torch.where(observed, observation, 0.0),
                "observed": observed,
                "previous_action": torch.randn(*shape, ACTION, generator=g, dtype=dtype),
                "is_init": torch.zeros(*shape, 1, dtype=torch.bool),
            },
            shape,
        )

    def state_keys(self, module: TensorDictModuleBase) -> list[Any]:
        return list(module.make_tensordict_primer().primers.keys(True, True))

    def some_state(
        self, module: TensorDictModuleBase, shape: tuple[int, ...], seed: int = 1
    ) -> TensorDict:
        """Return a recurrent state in mid-episode: what the module wrote after two steps."""
        dtype = next(module.parameters()).dtype
        frames = self.make_frames((*shape, 2), dtype, seed)
        frames["is_init"][..., 0, :] = True
        with torch.no_grad():
            return self.one_by_one(module, frames, None)["next"][..., -1].select(
                *self.state_keys(module)
            )

    def one_by_one(
        self, module: TensorDictModuleBase, frames: TensorDict, start: TensorDict | None
    ) -> TensorDict:
        """Run step by step as a collector does; the primer's zeros where an episode starts.

        The result holds the stored state at every step, as a collected rollout does.
        """
        keys = self.state_keys(module)
        primers = module.make_tensordict_primer().primers
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
            carried = step["next"]
            steps.append(step)
        return torch.stack(steps, len(batch))

    def as_sequence(self, module: TensorDictModuleBase, rollout: TensorDict) -> TensorDict:
        """Run over time from what a rollout stores, with what the module wrote left out."""
        keys = ["observation", "observed", "previous_action", "is_init"]
        with set_recurrent_mode(True):
            return module(rollout.select(*keys, *self.state_keys(module)))

    def written(self, module: TensorDictModuleBase) -> list[Any]:
        return [k for k in module.out_keys if not (isinstance(k, tuple) and k[0] == "next")]

    def assert_same(
        self, module: TensorDictModuleBase, received: TensorDictBase, expected: TensorDictBase
    ) -> None:
        for key in self.written(module):
            dtype = expected[key].dtype
            limit = self.tolerance64 if dtype == torch.float64 else self.tolerance32
            # The largest entry sets the scale: beliefs of raw sensors may be far from 1.
            scale = max(1.0, expected[key].abs().max().item())
            torch.testing.assert_close(
                received[key],
                expected[key],
                rtol=limit,
                atol=limit * scale,
                msg=lambda text, key=key: f"{key}: {text}",
            )

    # --- keys
    def test_every_out_key_is_written_and_no_other(self):
        module = self.make_module()
        rollout = self.one_by_one(module, self.make_frames((3, 4)), None)
        assert set(rollout.keys(True, True)) == {*module.in_keys, *module.out_keys}
        sequence = self.as_sequence(module, rollout)
        assert set(sequence.keys(True, True)) == {*module.in_keys, *module.out_keys}
        for key in module.out_keys:
            assert sequence[key].shape == rollout[key].shape, key
            assert sequence[key].dtype == rollout[key].dtype, key

    def test_keys_can_be_renamed_nested_ones_included(self):
        plain = self.make_module()
        named = self.make_module(
            in_keys={"observation": ("agent", "observation"), "is_init": "first"},
            out_keys={"features": ("agent", "embed")},
        )
        frames = self.make_frames((3, 4))
        frames["is_init"][:, 0] = True
        with set_recurrent_mode(True):
            expected = plain(frames.clone())["features"]
            renamed = frames.clone()
            renamed.rename_key_("observation", ("agent", "observation"))
            renamed.rename_key_("is_init", "first")
            received = named(renamed)
        assert torch.equal(received["agent", "embed"], expected)
        assert "features" not in received

    def test_dispatch_takes_tensors_by_name(self):
        module = self.make_module()
        rollout = self.one_by_one(module, self.make_frames((3, 4)), None)
        step = rollout[:, 1].select(*module.in_keys)
        expected = module(step.clone())
        kwargs = {k if isinstance(k, str) else "_".join(k): step[k] for k in module.in_keys}
        received = dict(zip(module.out_keys, module(**kwargs), strict=True))
        for key in module.out_keys:
            assert torch.equal(received[key], expected[key]), key

    # --- shapes, steps, sequences
    @pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
    def test_one_step_takes_any_batch_shape(self, shape):
        module = self.make_module()
        start = self.some_state(module, (6,))
        frames = self.make_frames((6, 1))
        each = self.one_by_one(module, frames, start)[:, 0]
        count = torch.Size(shape).numel()
        step = each.select(*module.in_keys)[:count].reshape(shape)
        out = module(step)
        assert out.batch_size == torch.Size(shape)
        self.assert_same(module, out.reshape(-1), each[:count])

    @pytest.mark.parametrize("shape", [(), (2,), (2, 3), (2, 3, 2)])
    def test_a_sequence_takes_any_number_of_leading_dimensions(self, shape):
        module = self.make_module()
        count = torch.Size(shape).numel()
        frames = self.make_frames((count, 5))
        frames["is_init"][:, 0] = True
        rollout = self.one_by_one(module, frames, None)
        out = self.as_sequence(module, rollout.reshape(*shape, 5))
        assert out.batch_size == (*shape, 5)
        self.assert_same(module, out.reshape(count, 5), rollout)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("start", ["episode start", "mid-episode"])
    def test_step_by_step_equals_the_whole_sequence(self, dtype, start):
        module = self.make_module(dtype=dtype)
        frames = self.make_frames((4, 12), dtype)
        frames["is_init"][1, 5] = True
        frames["is_init"][2, [3, 4, 9]] = True
        if start == "episode start":
            frames["is_init"][:, 0] = True
        state = None if start == "episode start" else self.some_state(module, (4,))
        rollout = self.one_by_one(module, frames, state)
        assert rollout["features"].dtype == dtype
        self.assert_same(module, self.as_sequence(module, rollout), rollout)

    def test_a_reset_inside_a_row_equals_two_sequences(self):
        module = self.make_module(dtype=torch.float64)
        frames = self.make_frames((2, 9), torch.float64)
        frames["is_init"][:, [0, 4]] = True
        whole = self.as_sequence(module, self.one_by_one(module, frames, None))
        parts = [
            self.as_sequence(module, self.one_by_one(module, part, None))
            for part in (frames[:, :4], frames[:, 4:])
        ]
        self.assert_same(module, whole, torch.cat(parts, 1))

    def test_a_row_goes_on_from_the_state_stored_at_its_first_step(self):
        module = self.make_module(dtype=torch.float64)
        frames = self.make_frames((2, 9), torch.float64)
        frames["is_init"][:, 0] = True
        rollout = self.one_by_one(module, frames, None)
        cut = self.as_sequence(module, rollout[:, 5:])
        self.assert_same(module, cut, rollout[:, 5:])
        # and the state matters: another one gives another belief
        other = rollout[:, 5:].clone()
        for key in self.state_keys(module):
            if other[key].is_floating_point():
                other[key] += 1.0
        assert not torch.allclose(
            self.as_sequence(module, other)["features"][:, 0], rollout["features"][:, 5]
        )

    def test_is_init_with_an_older_age_loads_the_stored_state(self):
        # two slices of one episode in one row, as TorchRL's SliceSampler lays them out
        module = self.make_module(dtype=torch.float64)
        frames = self.make_frames((2, 12), torch.float64)
        frames["is_init"][:, 0] = True
        rollout = self.one_by_one(module, frames, None)
        slices = [rollout[:, 2:5].clone(), rollout[:, 8:12].clone()]
        for piece in slices:
            piece["is_init"][:, 0] = True
        stitched = torch.cat(slices, 1)
        expected = torch.cat([rollout[:, 2:5], rollout[:, 8:12]], 1)
        assert (stitched[self.age_key][:, [0, 3]] > 0).all()
        self.assert_same(module, self.as_sequence(module, stitched), expected)
        self.assert_same(module, module(stitched.select(*module.in_keys)), expected)

    def test_an_episode_start_ignores_whatever_state_is_stored(self):
        module = self.make_module()
        frames = self.make_frames((3, 4))
        frames["is_init"][:, [0, 2]] = True
        rollout = self.one_by_one(module, frames, None)
        dirty = rollout.clone()
        for key in self.state_keys(module):
            if dirty[key].is_floating_point():
                dirty[key][:, [0, 2]] = 7.0
        self.assert_same(module, self.as_sequence(module, dirty), rollout)
        self.assert_same(module, module(dirty.select(*module.in_keys)), rollout)

    def test_the_age_counts_updates_since_the_reset(self):
        module = self.make_module()
        frames = self.make_frames((1, 6))
        frames["is_init"][:, [0, 4]] = True
        rollout = self.one_by_one(module, frames, None)
        assert rollout[self.age_key].flatten().tolist() == [0, 1, 2, 3, 0, 1]
        following = rollout["next"][self.age_key].flatten()
        assert following.tolist() == [1, 2, 3, 4, 1, 2]
        # without stored entries a sequence counts for itself
        with set_recurrent_mode(True):
            fresh = module(frames.clone())
        assert torch.equal(fresh["next"][self.age_key].flatten(), following)

    def test_sequences_without_recurrent_entries_begin_at_the_beginning(self):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][1, 3] = True
        with set_recurrent_mode(True), warnings.catch_warnings():
            warnings.simplefilter("error")
            received = module(frames.clone())
        frames["is_init"][:, 0] = True
        self.assert_same(module, received, self.one_by_one(module, frames, None))

    def test_single_steps_without_recurrent_entries_warn_once(self):
        module = self.make_module()
        step = self.make_frames((3,))
        with pytest.warns(UserWarning, match=r"make_tensordict_primer\(\)"):
            received = module(step.clone())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            module(step.clone())
        step["is_init"][:] = True
        expected = self.one_by_one(module, step.unsqueeze(-1), None)[:, 0]
        self.assert_same(module, received, expected)

    def test_non_contiguous_input_gives_the_same(self):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][:, 0] = True
        rollout = self.one_by_one(module, frames, None)
        strided = rollout.transpose(0, 1).contiguous().transpose(0, 1)
        assert not strided["observation"].is_contiguous()
        self.assert_same(module, self.as_sequence(module, strided), rollout)

    def test_what_was_read_is_left_as_it_was(self):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        rollout = self.one_by_one(module, frames, self.some_state(module, (3,)))
        before = rollout.select(*module.in_keys).clone()
        after = self.as_sequence(module, rollout)
        for key in module.in_keys:
            assert torch.equal(after[key], before[key]), key

    # --- modes
    def test_the_mode_is_a_context_or_a_default(self):
        module = self.make_module(default_recurrent_mode=True)
        plain = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][:, 0] = True
        rollout = self.one_by_one(plain, frames, None)
        # over time and step by step agree only if the first really ran over time
        dirty = rollout.select(*module.in_keys)
        for key in self.state_keys(module):
            if dirty[key].is_floating_point():
                dirty[key][:, 1:] = 7.0
        self.assert_same(module, module(dirty.clone()), rollout)
        with set_recurrent_mode(False):
            single = module(dirty.clone())["features"]
        assert not torch.allclose(single[:, 1:], rollout["features"][:, 1:])
        assert torch.equal(plain(dirty.clone())["features"], single)

    # --- TorchRL's machinery
    def test_its_primer_is_found_inside_a_sequence(self):
        module = self.make_module()
        head = TensorDictModule(nn.LazyLinear(ACTION), ["features"], ["action"])
        policy = TensorDictSequential(module, head)
        primer = get_primers_from_module(policy)
        assert set(primer.primers.keys(True, True)) == set(self.state_keys(module))
        for key in self.state_keys(module):
            assert ("next", *key) in module.out_keys
        env = with_belief_entries(TransformedEnv(StaircaseEnv(), Compose()), primer)
        check_env_specs(env)
        data = env.rollout(8, policy, break_when_any_done=False)
        assert data["next", "done"].any()
        self.check_collected(module, data)

    def check_collected(self, module: TensorDictModuleBase, data: TensorDictBase) -> None:
        """Assert that a rollout's beliefs are those of its frames, run over time."""
        age = torch.zeros_like(data[self.age_key][..., 0, :])
        for t in range(data.shape[-1]):
            started = data["is_init"][..., t, :] | (t == 0)
            stored = data[self.age_key][..., t, :]
            age = torch.where(started, stored if t == 0 else torch.zeros_like(age), age)
            assert torch.equal(stored, age)
            age = age + 1
        self.assert_same(module, self.as_sequence(module, data), data)

    def make_policy(self, module: TensorDictModuleBase, actions: int) -> TensorDictSequential:
        head = TensorDictModule(nn.LazyLinear(actions), ["features"], ["action"])
        return TensorDictSequential(module, head)

    def test_the_collector_registers_its_primer(self):
        module = self.make_module()
        collector = Collector(
            with_belief_entries(TransformedEnv(StaircaseEnv(), Compose())),
            self.make_policy(module, ACTION),
            frames_per_batch=24,
            total_frames=72,
            auto_register_policy_transforms=True,
        )
        try:
            batches = list(collector)
        finally:
            collector.shutdown()
        assert any(batch["next", "done"].any() for batch in batches)
        assert (batches[1][self.age_key][:, 0] > 0).any()  # a row that starts in mid-episode
        for batch in batches:
            self.check_collected(module, batch)

    @pytest.mark.parametrize("kind", ["serial", "parallel", "gymnasium"])
    def test_it_runs_in_batched_environments(self, kind):
        module = self.make_module(4, 1)
        primer = module.make_tensordict_primer
        if kind == "gymnasium":
            base = TransformedEnv(GymnasiumBatchEnv("InvertedPendulum-v5", 2), Compose())
            env = with_belief_entries(base, primer())
        elif kind == "serial":
            env = SerialEnv(2, lambda: belief_env(primer()))
        else:
            env = parallel_env(2, partial(belief_env, primer()))
        try:
            env.set_seed(0)
            with torch.no_grad():
                data = env.rollout(
                    40, self.make_policy(module, 1), break_when_any_done=False
                ).contiguous()
        finally:
            env.close(raise_if_closed=False)
        assert data["is_init"][:, 1:].any()
        self.check_collected(module, data)

    @pytest.mark.parametrize("over_time", [False, True])
    def test_compiled_without_a_graph_break_equals_eager(self, over_time):
        module = self.make_module()
        frames = self.make_frames((3, 4))
        frames["is_init"][1, 2] = True
        rollout = self.one_by_one(module, frames, self.some_state(module, (3,)))
        data = rollout.select(*module.in_keys).detach()
        parameters = list(module.parameters())
        torch._dynamo.reset()
        compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
        with set_recurrent_mode(over_time):
            expected, received = module(data.clone()), compiled(data.clone())
        self.assert_same(module, received, expected)
        for one, other in zip(
            torch.autograd.grad(self.differentiable(expected), parameters, allow_unused=True),
            torch.autograd.grad(self.differentiable(received), parameters, allow_unused=True),
            strict=True,
        ):
            assert (one is None) == (other is None)
            if one is not None:
                torch.testing.assert_close(other, one)

    def test_a_single_step_policy_can_be_exported(self):
        module = self.make_module()
        policy = self.make_policy(module, ACTION)
        out_keys = ["action", *[("next", *key) for key in self.state_keys(module)]]
        step = self.one_by_one(module, self.make_frames((3, 2)), None)[:, 1]
        step = step.select(*module.in_keys).detach()
        policy(step.clone())
        policy.select_out_keys(*out_keys)
        kwargs = {k if isinstance(k, str) else "_".join(k): step[k] for k in module.in_keys}
        expected = policy(**kwargs)
        exported = torch.export.export(policy, args=(), kwargs=kwargs, strict=False)
        for one, other in zip(exported.module()(**kwargs), expected, strict=True):
            torch.testing.assert_close(one, other)

    # --- parameters
    def test_the_state_survives_a_file(self):
        first, second = self.make_module(), self.make_module()
        with torch.no_grad():
            for parameter in first.parameters():
                parameter += 0.05
        second.load_state_dict(saved(first.state_dict()))
        frames = self.make_frames((3, 4))
        with set_recurrent_mode(True):
            expected, received = first(frames.clone()), second(frames.clone())
        assert torch.equal(received["features"], expected["features"])

    def test_a_deepcopy_computes_the_same_and_shares_nothing(self):
        first = self.make_module()
        second = copy.deepcopy(first)
        frames = self.make_frames((3, 4))
        with set_recurrent_mode(True):
            expected = first(frames.clone())["features"].clone()
            with torch.no_grad():
                for parameter in first.parameters():
                    parameter.zero_()
            assert torch.equal(second(frames.clone())["features"], expected)

    def test_every_parameter_gets_a_finite_gradient_over_time(self):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][:, 0] = True
        with set_recurrent_mode(True):
            out = module(frames)
        self.differentiable(out).backward()
        for name, parameter in module.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.any(), name

    @pytest.mark.gpu
    @pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
    def test_it_moves_to_a_gpu(self):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][:, 0] = True
        with set_recurrent_mode(True):
            expected = module(frames.clone())
            module = module.to("cuda")
            received = module(frames.to("cuda"))
        self.differentiable(received).backward()
        for spec in module.make_tensordict_primer().primers.values(True, True):
            assert spec.device.type == "cuda"
        for key in self.written(module):
            assert received[key].device.type == "cuda"
            torch.testing.assert_close(received[key].cpu(), expected[key], rtol=1e-3, atol=1e-4)
