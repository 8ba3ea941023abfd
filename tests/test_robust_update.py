"""The robust update: weights of readings, from leave-one-out scores to an exported policy."""

import math
import statistics
from typing import get_args

import pytest
import references
import torch
from filter_problems import by_hand, make_model, sequences
from torch import nn

from torchrl_drbpn import BeliefDivergedError, BeliefFilter, BeliefFilterModule, PolicyStep
from torchrl_drbpn.functional import innovation_weights, robust_sequence_weights
from torchrl_drbpn.functional.robust import Robust
from torchrl_drbpn.modules import GaussianTransition

OBS, ACTION, BATCH, TIME = 5, 2, 6, 5
MODELS = ["innovation", "information", "free", "full", "network", "propagated"]
KINDS = list(get_args(Robust))


def before(model):
    """Covariance of the step before the first, where it is read."""
    if model.covariance == "constant":
        return None
    return 0.4 * torch.eye(model.state_dim, dtype=torch.float64).expand(BATCH, -1, -1)


def inputs(model, wrong=0.25):
    """Sequences whose readings are off in a share; row 0 has none, row 1 one; two rows start."""
    mean, _, action, observation, observed, reset = sequences(model.state_dim, (BATCH,), TIME)
    g = torch.Generator().manual_seed(1)
    spiked = torch.rand(BATCH, TIME, OBS, generator=g) < wrong
    observation = torch.where(spiked, 30.0 * observation, observation)
    observed[0], observed[1] = False, torch.arange(OBS) == 2
    reset[-2:, 0] = True
    return mean, action, observation, observed, reset


def first(data):
    return data[0], *(x[:, 0] for x in data[1:])


def textbook_weights(v, S, r, seen, kind, c):
    """Weights of one vector of readings, each conditioned on the others, row by row."""
    rows = [i for i in range(len(v)) if seen[i]]
    marginal = {i: abs(float(v[i])) / math.sqrt(S[i, i]) for i in rows}
    bound, held = {}, torch.zeros_like(v)
    for i in rows:
        others = [marginal[j] for j in rows if j != i]
        excess = statistics.median_low(others) / 0.6744897501960817 if others else 1.0
        bound[i] = c * max(1.0, excess)
        held[i] = S[i, i] * (max(1.0, marginal[i] / bound[i]) - 1.0)
    for _ in range(2):
        before = held.clone()
        for i in rows:
            o = [j for j in rows if j != i]
            link = torch.linalg.solve(S[o][:, o] + before[o].diag(), S[o, i]) if o else v[o]
            variance = S[i, i] - link @ S[o, i]
            score = (v[i] - link @ v[o]).abs() / variance.sqrt() / bound[i]
            off = score.clamp_min(1.0) - 1.0 if kind == "huber" else (score / 2) ** 2
            held[i] = variance * off
    return r / (r + held)


def textbook(model, kind, c, data):
    """Filter by loops over rows, steps and readings; the weights."""
    H, R, found = model.emission.matrix, model.emission.cov(), []

    def noise(m, P, x, seen, offset):
        with torch.no_grad():
            v = torch.where(seen, x - H @ m - offset, 0.0)
            w = textbook_weights(v, H @ P @ H.mT + R, R.diagonal(), seen, kind, c)
        found.append(w)
        return R + torch.diag(R.diagonal() * (1 / w - 1))

    truth = by_hand(model, data[0], before(model), *data[1:], noise=noise)
    return truth, torch.stack(found).unflatten(0, data[-1].shape)


@pytest.mark.parametrize("robust", KINDS)
@pytest.mark.parametrize("kind", MODELS)
def test_a_robust_filter_is_the_textbook_in_values_and_all_gradients(kind, robust):
    model = make_model(kind, robust=robust, robust_threshold=2.0)
    data = inputs(model)
    mean, *rest = data
    expected, weights = textbook(model, robust, 2.0, data)
    low = weights[data[3]] < 0.5
    assert 10 < low.sum() < len(low) - 10
    out = model(mean, before(model), *rest, return_cov=True)
    truth, found = ((x.mean, x.cov, x.log_likelihood) for x in (expected, out))
    for value, expected in zip(found, truth, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-7, atol=1e-7)
    totals = [sum(x.sin().sum() for x in outputs) for outputs in (found, truth)]
    gradients = [torch.autograd.grad(total, list(model.parameters())) for total in totals]
    for value, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", MODELS)
def test_readings_within_the_threshold_are_believed_to_the_bit(kind):
    model, plain = make_model(kind, robust="huber", robust_threshold=1e3), make_model(kind)
    mean, *rest = inputs(model, wrong=0.0)
    options = {"cov": before(model), "robust": "huber", "threshold": 1e3}
    weights = robust_sequence_weights(model.state_space(), mean, *rest, **options)
    assert (weights == 1).all()
    assert not weights.requires_grad
    outs = (m(mean, before(m), *rest, return_cov=True) for m in (model, plain))
    for a, b in zip(*outs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def correlated(off, robust, n=5, c=3.0):
    """Weights, belief, and the mean of the right ones, of n sensors of one state.

    P = 1, R = .01, state .5; readings are spread evenly within a noise deviation.
    """
    one, r = torch.ones(n, 1).double(), torch.full((n,), 0.01).double()
    x = 0.5 + 0.1 * torch.linspace(-1, 1, n).double()
    for i, error in off.items():
        x[i] += error
    S, right = one @ one.mT + r.diag(), torch.tensor([i not in off for i in range(n)])
    w, everything = torch.ones(n).double(), torch.ones(n, dtype=torch.bool)
    if robust is not None:
        w = innovation_weights(x, S, r, everything, robust, c)
    start = torch.zeros(1).double(), torch.eye(1).double()
    mean, cov = references.update(*start, x, everything, one, (r / w).diag())
    return w, mean, cov, references.update(*start, x, right, one, r.diag())[0]


@pytest.mark.parametrize("robust", KINDS)
@pytest.mark.parametrize("n", [1, 2, 5])
def test_one_reading_moved_to_infinity_moves_the_mean_less_than_its_bound(n, robust):
    """The bound: c deviations of the belief from the other readings, whatever their number.

    huber: as |v_i| grows the mean tends to that of the others plus P_i h c / sigma_i, with P_i and
    sigma_i^2 = h P_i h' + r the variances of state and reading given the others, and
    |P_i h| <= sqrt(P_i) sigma_i. imq: to that of the others. With no other reading, those are the
    prediction.
    """
    means = torch.stack([correlated({0: 10.0**k}, robust, n)[1] for k in (3, 6, 9, 12)])
    w, _, _, right = correlated({0: 1e12}, robust, n)
    assert w[0] < 1e-10
    others = 1 / (1 + w[1:].sum() / 0.01)
    limit = 3.0 * others.sqrt() if robust == "huber" else torch.tensor(1e-3).double()
    spread = 0.5 * others.sqrt()  # imq weighs the right readings by their own spread
    assert ((means - right).abs() < limit + spread).all()
    torch.testing.assert_close(means[1:], means[-1:].expand(3, 1), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("robust", KINDS)
def test_half_of_independent_sensors_wrong_at_once_is_withstood(robust):
    """Six states, a sensor each, three of them off by 1e6: the belief stays within 4 deviations."""
    n = 6
    S, r = (1.0 + 0.01) * torch.eye(n).double(), torch.full((n,), 0.01).double()
    v = torch.tensor([0.5, -0.3, 0.1, 1e6, -1e6, 1e6]).double()
    w = innovation_weights(v, S, r, torch.ones(n, dtype=torch.bool), robust, 3.0)
    moved = v / (1.0 + r / w)
    assert (moved[:3] - v[:3] / 1.01).abs().max() < (1e-9 if robust == "huber" else 0.05)
    assert moved[3:].abs().max() < 4.0
    # One more, and the median is theirs: most of what arrives must be right.
    v[2] = 1e6
    w = innovation_weights(v, S, r, torch.ones(n, dtype=torch.bool), robust, 3.0)
    assert (v / (1.0 + r / w))[2:].abs().min() > 1e5


@pytest.mark.parametrize("robust", KINDS)
def test_where_all_readings_agree_on_another_state_the_belief_follows_them(robust):
    w, mean, *_ = correlated(dict.fromkeys(range(5), 1e4), robust)
    assert w.min() > 0.9
    assert mean > 9e3
    model = make_model("innovation", robust=robust)
    _, action, observation, observed, reset = first(inputs(model, wrong=0.0))
    given = (action, observation, torch.ones_like(observed), torch.zeros_like(reset))
    lost = torch.full((BATCH, OBS), 1e4, dtype=torch.float64)
    follows = model.step(lost, None, *given).mean
    free = make_model("innovation").step(lost, None, *given).mean
    predicted = model.predict(lost, action, torch.zeros_like(reset)).mean
    assert (follows - free).norm() < 0.2 * (predicted - free).norm()


@pytest.mark.parametrize("kind", MODELS)
def test_a_policy_step_and_its_export_keep_the_robust_update(kind):
    model = make_model(kind, robust="huber", robust_threshold=1.0)
    module = BeliefFilterModule(model, policy_input="mean_cov")
    step = PolicyStep(module, nn.Linear(module.feature_dim, ACTION, dtype=torch.float64))
    mean, action, observation, observed, reset = first(inputs(model))
    expected = model.step(mean, before(model), action, observation, observed, reset).mean
    model.robust = None  # the step is a copy
    believed = model.step(mean, before(model), action, observation, observed, reset).mean
    args = (observation, observed, action, reset.unsqueeze(-1), mean)
    args = (*args, torch.where(reset, 0, 3).unsqueeze(-1))
    args = args if before(model) is None else (*args, before(model))
    torch.testing.assert_close(step(*args)[1], expected, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(believed, expected, atol=1e-3)
    if kind in ("innovation", "information"):
        exported = torch.export.export(step, args).module()
        torch.testing.assert_close(exported(*args), step(*args))


def test_float32_and_a_transition_of_your_own_have_the_weights_too():
    class Own(nn.Module):
        state_dim = OBS

        def forward(self, mean, action):
            del action
            return 0.9 * mean, torch.eye(OBS, dtype=mean.dtype).expand(*mean.shape, OBS)

    for transition in (Own(), GaussianTransition(OBS, ACTION)):
        model = BeliefFilter(OBS, ACTION, transition=transition, robust="imq")
        mean, action, observation, observed, reset = inputs(model)
        narrow = (mean.float(), action.float(), observation.float(), observed, reset)
        out = model(narrow[0], None, *narrow[1:])
        assert out.mean.dtype == torch.float32
        wide = textbook(model, "imq", 4.0, narrow)[0].mean
        torch.testing.assert_close(out.mean, wide.float(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("robust", [None, *KINDS])
@pytest.mark.parametrize(
    ("spoiled", "error", "message"),
    [
        ("model", BeliefDivergedError, "the learned model diverged"),
        ("mean", ValueError, "`mean` holds NaN"),
        ("action", ValueError, "`previous_action` holds NaN"),
        ("observation", ValueError, r"`observation` holds NaN .*components \[0, 1, 2, 3, 4\]"),
        ("infinite", ValueError, "`observation` holds infinite readings"),
    ],
)
def test_an_error_names_its_cause_whatever_the_update(spoiled, error, message, robust):
    model = make_model("innovation", robust=robust)
    mean, action, observation, observed, reset = first(inputs(model))
    # a mean or an action is named where nothing was observed too: the likelihood is 0 then
    observed[:], reset[:] = spoiled not in ("mean", "action"), False
    given = {"mean": mean, "action": action, "observation": observation}
    with torch.no_grad():
        if spoiled == "model":
            for name, parameter in model.transition.named_parameters():
                if name.endswith("weight"):
                    parameter.fill_(torch.inf)
        elif spoiled == "infinite":
            observation[2, 3] = -torch.inf
        else:
            given[spoiled][3] = torch.nan
    with pytest.raises(error, match=message):
        model.step(mean, None, action, observation, observed, reset)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robust": "gate"}, "`robust` must be one of huber, imq, or None"),
        *(
            ({"robust_threshold": bad}, "`robust_threshold` must be a positive, finite number")
            for bad in (0.0, -1.0, math.inf, math.nan, True, "3")
        ),
    ],
)
def test_an_update_that_is_none_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        BeliefFilter(OBS, ACTION, **options)
    model = make_model("innovation", robust="huber")
    for name, value in options.items():
        setattr(model, name, value)
    mean, *rest = first(inputs(model))
    with pytest.raises(ValueError, match=message):
        model.step(mean, None, *rest)
