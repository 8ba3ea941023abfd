"""What the transformer belief remembers, for how long, and what its attention computes."""

import pytest
import torch
from belief_frames import BeliefFrames
from beliefs.transformer import MemoryAttention
from suite_environments import ACTION, OBS
from torch import nn
from torchrl.modules import set_recurrent_mode
from training.config import build, choice
from training.errors import UserError

MEMORY, LENGTH = ("recurrent", "memory"), ("recurrent", "length")


def make_module(**sizes):
    sizes = {"window": 4, "width": 16, "layers": 1, **sizes}
    settings = choice("belief", "transformer", **sizes)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        belief = build("belief", settings, obs_dim=OBS, action_dim=ACTION)
    return belief.module.double()


class Frames(BeliefFrames):
    observation = "normalized_observation"


def make_frames(batch, time):
    """Return what arrived over some steps of an episode that goes on."""
    return Frames().make_frames((batch, time), torch.float64, obs=OBS)


def reach(module, frames):
    """Return whether the features of a step (row) move with what arrived at another (column)."""
    frames = frames.clone()
    observation = frames["normalized_observation"].requires_grad_()
    with set_recurrent_mode(True):
        features = module(frames)["features"]
    weights = torch.linspace(1, 2, features.shape[-1], dtype=torch.float64)
    rows = [
        torch.autograd.grad((features[:, t] * weights).sum(), observation, retain_graph=True)[0]
        for t in range(frames.shape[1])
    ]
    return torch.stack([(row != 0).any(-1).any(0) for row in rows])


def in_steps(module, frames):
    """Run one step at a time from an empty memory."""
    with torch.no_grad():
        return Frames().one_by_one(module, frames, None)


def band(time, steps):
    """Return whether a step (row) comes after another (column), by at most that many steps."""
    distance = torch.arange(time).unsqueeze(1) - torch.arange(time)
    return (distance >= 0) & (distance <= steps)


def test_attention_is_that_of_torch_with_positions_added_to_the_keys():
    rows, time, window, width, heads = 3, 4, 5, 12, 3
    entries = window - 1 + time
    ours = MemoryAttention(width, heads, window).double()
    theirs = nn.MultiheadAttention(width, heads, batch_first=True).double()
    for parameter in ours.parameters():
        nn.init.normal_(parameter)
    with torch.no_grad():
        weights = [ours.query.weight, ours.key.weight, ours.value.weight]
        theirs.in_proj_weight.copy_(torch.cat(weights))
        theirs.in_proj_bias.zero_()[:width].copy_(ours.query.bias)
        theirs.out_proj.load_state_dict(ours.out.state_dict())
    x = torch.randn(rows, entries, width, dtype=torch.float64, requires_grad=True)
    visible = torch.rand(rows, time, entries) < 0.7
    visible[:, range(time), range(window - 1, entries)] = True
    # Step by step, with a window of its own each.
    expected = torch.zeros(rows, time, width, dtype=torch.float64)
    for t in range(time):
        seen = x[:, t : t + window]
        mask = torch.zeros(rows, window, dtype=torch.float64)
        mask = mask.masked_fill(~visible[:, t, t : t + window], float("-inf"))
        mask = mask.repeat_interleave(heads, 0).unsqueeze(1)
        key = seen + ours.position
        out, _ = theirs(seen[:, -1:], key, seen, attn_mask=mask, need_weights=False)
        expected[:, t] = out[:, 0]
    received = ours(x, visible)
    torch.testing.assert_close(received, expected)
    gradients = [
        torch.autograd.grad(out.square().sum(), [x, ours.position]) for out in (received, expected)
    ]
    for ours_grad, theirs_grad in zip(*gradients, strict=True):
        torch.testing.assert_close(ours_grad, theirs_grad)


@pytest.mark.parametrize(("window", "layers"), [(1, 2), (4, 1), (3, 2)])
def test_features_depend_on_as_many_steps_as_the_layers_reach_back(window, layers):
    module = make_module(window=window, layers=layers)
    expected = band(9, layers * (window - 1))
    assert torch.equal(reach(module, make_frames(2, 9)), expected)


def test_an_episode_start_hides_the_stored_memory():
    module = make_module(layers=2)
    stored = in_steps(module, make_frames(3, 5))["next"][:, -1].select(MEMORY, LENGTH)
    frames = make_frames(3, 6)[:, 5]
    frames["is_init"][:] = True
    fresh = module(frames.clone())
    begun = module(frames.clone().update(stored))
    assert torch.equal(begun["features"], fresh["features"])
    assert (begun["next", *LENGTH] == 1).all()
    frames["is_init"][:] = False
    gone_on = module(frames.clone().update(stored))
    assert not torch.isclose(gone_on["features"], fresh["features"]).all(-1).any()


def test_what_lies_beyond_the_length_of_the_memory_counts_for_nothing():
    module = make_module(window=6, layers=2)
    frames = make_frames(2, 4).update(in_steps(module, make_frames(2, 4)).select("recurrent"))
    assert frames[LENGTH].squeeze(-1).tolist() == [[0, 1, 2, 3]] * 2
    with torch.no_grad():
        for recurrent in (False, True):
            with set_recurrent_mode(recurrent):
                expected = module(frames.clone())["features"]
                changed = frames.clone()
                for length in range(4):
                    changed[MEMORY][:, length, :, : 5 - length] = 9.0
                assert torch.equal(module(changed)["features"], expected)
                changed = frames.clone()
                changed[MEMORY][:, 3, :, -3] = 9.0
                changed = changed[:, 3:]
                assert not torch.equal(module(changed)["features"], expected[:, 3:])


def test_sequences_and_steps_write_the_same_memory():
    module = make_module(layers=2)
    frames = make_frames(2, 9)
    frames["is_init"][0, 4] = True
    steps = in_steps(module, frames)
    with set_recurrent_mode(True):
        sequence = module(frames.clone())
    length = [[1, 2, 3, 3, 1, 2, 3, 3, 3], [1, 2, 3, 3, 3, 3, 3, 3, 3]]
    assert sequence["next", *LENGTH].squeeze(-1).tolist() == length
    assert torch.equal(steps["next", *LENGTH], sequence["next", *LENGTH])
    assert sequence["next", *MEMORY].shape == (2, 9, 2, 3, 16)
    # What lies beyond the length counts for nothing: the row without a start is compared.
    torch.testing.assert_close(sequence["next", *MEMORY][1], steps["next", *MEMORY][1])


def test_no_gradient_flows_into_the_memory():
    module = make_module()
    frames = make_frames(2, 3)
    for recurrent in (False, True):
        with set_recurrent_mode(recurrent):
            out = module(frames.clone())
        assert out["features"].requires_grad
        assert not out["next", *MEMORY].requires_grad


@pytest.mark.parametrize(
    "sizes", [{"window": 0}, {"layers": 0}, {"heads": 0}, {"width": 0}, {"heads": 3}]
)
def test_sizes_that_do_not_fit_are_named(sizes):
    with pytest.raises(UserError, match="`belief`: `window`, `width`, `layers` and"):
        make_module(**sizes)
