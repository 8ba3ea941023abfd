"""What `BeliefFilter` is held to: the textbook by hand, any transition, and clear refusals."""

import copy
import functools
from dataclasses import replace

import pytest
import torch
from filter_problems import Inputs, by_hand, sequences
from refusals import refuses
from small_agents import make_filter
from torch import nn

from torchrl_drbpn import BeliefFilter, GaussianTransition, LinearGaussianEmission, functional

OBS, ACTION = 5, 2
F64 = torch.float64


class SineTransition(nn.Module):
    """A transition of the user's own: s' = s + sin(W s) + C a, Q growing with the state."""

    def __init__(self, state):
        super().__init__()
        g = torch.Generator().manual_seed(3)
        self.state_dim, self.action_dim = state, ACTION
        self.W = nn.Parameter(torch.randn(state, state, generator=g, dtype=F64))
        self.C = nn.Parameter(torch.randn(state, ACTION, generator=g, dtype=F64))

    def forward(self, mean, action):
        moved = mean + torch.sin(mean @ self.W.mT) + action @ self.C.mT
        return moved, torch.diag_embed(0.1 + 0.1 * mean.square())


GAUSSIAN = functools.partial(GaussianTransition, action_dim=ACTION, dtype=F64)
NETWORK = functools.partial(GAUSSIAN, hidden_sizes=(8,), cov_network=True)
KINDS = {
    "free Q": GAUSSIAN,
    "free full Q": functools.partial(GAUSSIAN, cov="full"),
    "network Q": NETWORK,
    "network full Q": functools.partial(NETWORK, cov="full"),
    "own module": SineTransition,
}


def make_kind(kind, state, noise="diag"):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        emission = LinearGaussianEmission(OBS, state, ACTION, cov=noise, dtype=F64)
        parts = {"transition": KINDS[kind](state), "emission": emission}
    return make_filter(OBS, ACTION, F64, state, initial_cov="full", **parts)


@pytest.mark.parametrize("noise", ["diag", "full"])
@pytest.mark.parametrize("state", [3, 5, 7])
@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_equal_a_hand_loop(kind, state, noise):
    model, inputs = make_kind(kind, state, noise), sequences(state)
    expected, out = by_hand(model, *inputs), model(*inputs, return_cov=True)
    same = functools.partial(torch.testing.assert_close, rtol=1e-9, atol=1e-10)
    for name in ("mean", "cov", "log_likelihood"):
        same(getattr(out, name), getattr(expected, name))

    def gradient(mean, ll):
        total = (mean * torch.linspace(-1, 1, mean.shape[-1], dtype=F64)).sum() + ll.sum()
        return torch.autograd.grad(total, list(model.parameters()))

    for received, wanted in zip(
        gradient(out.mean, out.log_likelihood),
        gradient(expected.mean, expected.log_likelihood),
        strict=True,
    ):
        torch.testing.assert_close(received, wanted, rtol=1e-8, atol=1e-9)
    # one step at a time, and a covariance only where it is asked for
    assert model(*inputs).cov is None
    mean = inputs.mean
    for t in range(inputs.reset.shape[-1]):
        args = (mean, None, *(value[:, t] for value in inputs[2:]))
        step = model.step(*args, return_cov=True)
        assert model.step(*args).cov is None
        for part, wanted in zip(step, out, strict=True):
            same(part, wanted[:, t])
        mean = step.mean


@pytest.mark.parametrize(("obs", "state"), [(4, 4), (17, 17), (105, 32)])
def test_the_state_has_as_many_components_as_the_observation_up_to_32(obs, state):
    model = BeliefFilter(obs, ACTION)
    assert model.state_dim == state
    assert model.transition.residual
    # which it is only where the sensors see the whole state
    assert not BeliefFilter(obs, ACTION, obs + 1).transition.residual


def test_the_state_follows_the_parts_that_are_given():
    transition = GaussianTransition(7, ACTION)
    assert BeliefFilter(OBS, ACTION, transition=transition).state_dim == 7
    emission = LinearGaussianEmission(OBS, 4, ACTION)
    assert BeliefFilter(OBS, ACTION, emission=emission).state_dim == 4


@pytest.mark.parametrize("kind", ["diag", "full"])
def test_the_initial_belief_starts_at_zero_with_its_std(kind):
    model = BeliefFilter(OBS, ACTION, 3, initial_std=0.7, initial_cov=kind, dtype=F64)
    assert not model.initial_mean.any()
    expected = 0.49 * torch.eye(3, dtype=F64)
    torch.testing.assert_close(model.initial_cov, expected, rtol=1e-12, atol=1e-14)


def changed(base, method, change):
    """Return a subclass of which one method returns something else."""

    def own(self, *args, **kwargs):
        return change(getattr(base, method)(self, *args, **kwargs))

    return type("Own", (base,), {method: own})


Scaled = changed(LinearGaussianEmission, "forward", lambda x: 2 * x + 1)
Squared = changed(LinearGaussianEmission, "forward", torch.square)
Negative = changed(LinearGaussianEmission, "compact_cov", lambda r: r - 1)
Turned = changed(GaussianTransition, "forward", lambda p: p._replace(mean=-p.mean))
NegativeQ = changed(GaussianTransition, "cov", lambda q: q - torch.eye(3))
UPPER = 0.01 * torch.ones(3, 3).triu(1)
Skew = changed(GaussianTransition, "forward", lambda p: p._replace(cov=p.cov + UPPER))
NegativeStart = changed(
    BeliefFilter, "state_space", lambda m: replace(m, initial_cov=-torch.ones(3))
)


def test_the_forward_of_a_subclass_counts():
    model, inputs = make_filter(OBS, ACTION, F64, state=3), sequences(3)
    for part, subclass in (("emission", Scaled), ("transition", Turned)):
        own = copy.deepcopy(model)
        getattr(own, part).__class__ = subclass
        step = (inputs.mean, None, *(value[:, 0] for value in inputs[2:]))
        moved = own.predict(inputs.mean, step[2], step[-1])
        offset = own.emission(torch.zeros_like(inputs.mean), step[2])
        H = 2 * own.emission.matrix if part == "emission" else own.emission.matrix
        expected = functional.update(moved, *step[3:5], H, own.emission.cov(), offset)
        torch.testing.assert_close(own.step(*step).mean, expected.mean, rtol=1e-9, atol=1e-9)
        assert not torch.equal(own.step(*step).mean, model.step(*step).mean)


test_a_filter_that_cannot_be_is_refused_at_construction = refuses(
    ({"state_dim": 0}, "`state_dim` must be an int of at least 1, got 0"),
    ({"obs_dim": 0}, "must be an int of at least 1, got 0"),
    ({"action_dim": 0}, "`action_dim` must be an int of at least 1, got 0"),
    ({"obs_dim": 0, "state_dim": None}, "`obs_dim` must be an int of at least 1, got 0"),
    ({"covariance": "grown"}, "`covariance` must be one of constant, propagated, got 'grown'"),
    ({"initial_cov": "scalar"}, "`initial_cov` must be one of diag, full, got 'scalar'"),
    ({"initial_std": 0.0}, "`initial_std` must be above its floor"),
    ({"transition": GaussianTransition(4, ACTION)}, "has state_dim=4, the filter state_dim=3"),
    ({"transition": GaussianTransition(3, 9)}, "has action_dim=9, the filter action_dim=2"),
    ({"emission": LinearGaussianEmission(9, 3, ACTION)}, "has obs_dim=9, the filter obs_dim=5"),
    ({"emission": Squared(OBS, 3, ACTION)}, "`emission` must be affine"),
    ({"emission": Negative(OBS, 3, ACTION)}, "`emission, R` is not symmetric"),
    ({"transition": NegativeQ(3, ACTION)}, "`transition, Q` is not symmetric"),
    ({"transition": Skew(3, ACTION)}, "`transition, Q` is not symmetric"),
    (lambda: NegativeStart(OBS, ACTION, 3), "`initial_cov` is not symmetric positive definite"),
    make=functools.partial(BeliefFilter, obs_dim=OBS, action_dim=ACTION, state_dim=3),
)


@pytest.mark.parametrize("method", ["forward", "step"])
@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("observed", torch.ones(3, 6, OBS),
         r"bool of shape \(\*batch, obs\) = \(3, 6, 5\), got float32 \(3, 6, 5\)"),
        ("observed", torch.ones(3, 6, 1).bool(), r"bool of shape .*got bool \(3, 6, 1\)"),
        ("observation", torch.ones(3, 6, 4, dtype=F64),
         r"float64 of shape \(\*batch, obs\) = \(3, 6, 5\).*environment"),
        ("previous_action", torch.ones(3, 6, 1, dtype=F64),
         r"float64 of shape \(\*batch, action\) = \(3, 6, 2\)"),
        ("observation", torch.ones(3, 6, OBS), "float64 of shape .*got float32 .*DoubleToFloat"),
        ("reset", torch.zeros(3, 6).long(), r"bool of shape \(\*batch,\) = .* got int64 \(3, 6\)"),
        ("mean", torch.zeros(3, 9, dtype=F64),
         r".*shape \(\*batch, state\) = \(3, 3\), got .*\(3, 9\)"),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line(method, name, value, message):
    inputs, message = sequences(3)._replace(**{name: value}), f"`{name}` must be {message}"
    if method == "step":
        inputs = Inputs(inputs.mean, None, *(value[:, 0] for value in inputs[2:]))
        message = message.replace(r"3, 6, ", "3, ").replace(r"(3, 6\)", r"(3,\)")
    model = make_kind("free Q", 3)
    with pytest.raises(ValueError, match=message):
        getattr(model, method)(*inputs)


def test_a_start_that_is_no_number_is_named():
    data, model = sequences(3), BeliefFilter(OBS, ACTION, 3, covariance="propagated").double()
    inputs = data._replace(cov=torch.full((3, 3, 3), torch.nan, dtype=F64))
    with pytest.raises(ValueError, match="`cov` holds NaN or inf: the filter cannot start"):
        model(*inputs)


def test_the_check_of_readings_can_be_off():
    inputs = sequences(3)
    inputs.observation[1, 2, 4] = torch.nan  # frame 2 has arrived whole
    unchecked = make_filter(OBS, ACTION, F64, state=3, validate=False)(*inputs)
    assert not unchecked.log_likelihood[1, 2].isfinite()
    assert unchecked.log_likelihood[0].isfinite().all()
