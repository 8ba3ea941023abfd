"""The recipe's other belief modules: recurrent networks, a transformer, last-value filling.

One step at a time equals whole sequences, episode starts inside them included; the auxiliary
likelihood counts what arrived and nothing else; collected data give a probability ratio of 1.
"""

from __future__ import annotations

import pytest
import recipe_tools
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module

OBS, ACTION, TIME = 5, 2, 7
RECURRENT = ["gru", "gru_action", "gru belief.cell=lstm", "transformer belief.window=4"]


def make_belief(name: str):
    from assembly.beliefs import build_belief

    config = recipe_tools.make_config(*f"belief={name}".split())
    torch.manual_seed(0)
    return build_belief(config["belief"], obs_dim=OBS, action_dim=ACTION, normalize="entry")


def make_frames(batch: int, seed: int = 0) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    observed = torch.rand(batch, TIME, OBS, generator=g) < 0.6
    is_init = torch.zeros(batch, TIME, 1, dtype=torch.bool)
    is_init[:, 0] = True
    is_init[0, 3] = True
    return TensorDict(
        {
            "observation": torch.where(observed, torch.randn(batch, TIME, OBS, generator=g), 0.0),
            "observed": observed,
            "previous_action": torch.randn(batch, TIME, ACTION, generator=g),
            "is_init": is_init,
        },
        [batch, TIME],
    )


def step_by_step(module, frames: TensorDict) -> TensorDict:
    """Run as a collector does: the primer's zeros at a start, else what the step before wrote."""
    primers = get_primers_from_module(module, warn=False).primers
    carried, steps = None, []
    for t in range(TIME):
        step = frames[:, t].clone()
        for key in primers.keys(True, True):
            zero = torch.zeros(len(step), *primers[key].shape, dtype=primers[key].dtype)
            first = step["is_init"].reshape(-1, *[1] * primers[key].ndim)
            step.set(key, zero if carried is None else torch.where(first, zero, carried[key]))
        module(step)
        carried = step["next"]
        steps.append(step)
    return torch.stack(steps, 1)


@pytest.mark.parametrize("name", RECURRENT)
def test_step_by_step_equals_the_whole_sequence(name):
    module = make_belief(name).module
    rollout = step_by_step(module, make_frames(3))
    with set_recurrent_mode(True):
        out = module(rollout.select(*module.in_keys))
    for key in ("features", ("belief", "log_likelihood")):
        assert out[key].shape == rollout[key].shape
        assert torch.allclose(out[key], rollout[key], atol=1e-5), key


@pytest.mark.parametrize("name", RECURRENT)
def test_a_cut_row_goes_on_from_the_stored_state(name):
    module = make_belief(name).module
    rollout = step_by_step(module, make_frames(3))
    with set_recurrent_mode(True):
        tail = module(rollout[:, 4:].select(*module.in_keys))
    for key in ("features", ("belief", "log_likelihood")):
        assert torch.allclose(tail[key], rollout[key][:, 4:], atol=1e-5), key


def test_the_likelihood_is_that_of_the_entries_that_arrived():
    module = make_belief("gru").module
    frames = make_frames(3)
    frames["observed"][:] = False
    frames["observation"][:] = float("nan")
    frames["observed"][1, 2, 4] = True
    frames["observation"][1, 2, 4] = 0.7
    value = module.foresight(torch.zeros(3, TIME, 64), frames)
    expected = torch.zeros(3, TIME)
    ahead = module.foresight.mean(torch.cat([torch.zeros(64), frames["previous_action"][1, 2]]))
    density = torch.distributions.Normal(ahead[4], 1.0).log_prob(torch.tensor(0.7))
    expected[1, 2] = density.detach()
    assert torch.allclose(value, expected, atol=1e-5)


def test_only_gru_action_reads_the_action():
    changed = make_frames(3)
    changed["previous_action"] += 1.0
    for name, reads in (("gru", False), ("gru_action", True)):
        module = make_belief(name).module
        with set_recurrent_mode(True):
            before = module(make_frames(3))["features"]
            after = module(changed.clone())["features"]
        assert torch.equal(before, after) is not reads


def test_a_wrong_cell_is_named():
    from assembly.errors import UserError

    with pytest.raises(UserError, match="`cell` must be 'gru' or 'lstm', got 'rnn'"):
        make_belief("gru belief.cell=rnn")


@pytest.mark.parametrize(
    "name", ["gru", "gru_action", "transformer", "fill", "fill belief.with_mask=true"]
)
def test_fresh_data_give_a_ratio_of_one(name):
    from assembly.rollout import add_advantages, to_sequences
    from assembly.settings import read_settings
    from assembly.training import assemble

    overrides = ["env=inverted_pendulum", "experiment=smoke", *f"belief={name}".split()]
    settings = read_settings(recipe_tools.make_config(*overrides))
    training = assemble(settings)
    for _ in range(2):
        data = training.collector.rollout()
    add_advantages(data, training.agent, training.gae)
    loss = training.algorithm.loss
    out = loss(to_sequences(data, loss, settings.optim.sequence_length))
    assert torch.allclose(out["max_ratio"], torch.ones(()), atol=1e-4)
    assert torch.allclose(out["ESS"].mean(), torch.ones(()), atol=1e-4)
    if name.startswith("fill"):
        # where nothing arrived the features still hold a value: the last one
        assert (data["features"][..., : data["observed"].shape[-1]] != 0).float().mean() > 0.9


def test_the_transformer_forgets_what_lies_beyond_its_window():
    module = make_belief("transformer belief.window=3").module
    frames = make_frames(2)
    frames["is_init"][:, 1:] = False
    changed = frames.clone()
    changed["observation"][:, 0] += 1.0
    with set_recurrent_mode(True):
        before, after = module(frames)["features"], module(changed)["features"]
    assert not torch.allclose(before[:, :3], after[:, :3])
    assert torch.allclose(before[:, 3:], after[:, 3:])


def test_the_transformer_sees_nothing_of_the_episode_before():
    module = make_belief("transformer belief.window=6").module
    frames = make_frames(2)
    changed = frames.clone()
    changed["observation"][0, :3] += 1.0  # row 0 starts anew at step 3
    with set_recurrent_mode(True):
        before, after = module(frames)["features"], module(changed)["features"]
    assert torch.allclose(before[0, 3:], after[0, 3:])
