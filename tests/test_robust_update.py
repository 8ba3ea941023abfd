"""The robust update: weights of readings, from leave-one-out scores to an exported policy.

Specified here, in float64: the weights are those of a textbook loop that conditions each reading on
the others; how far off one reading is makes no difference beyond a bound that is stated;
correlated sensors, half of them wrong, one alone; acting, sequences, loss and export agree. The
command line: test_evaluate.py; a weight as a noise variance: test_functional_filtering.py.
"""

from __future__ import annotations

import math
import statistics
from typing import Any, get_args

import oracles
import pytest
import torch
from small_agents import make_agent, make_filter
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss

from torchrl_drbpn import (
    BeliefDivergedError,
    BeliefFilter,
    BeliefFilterModule,
    BeliefModelLoss,
    DRBPNLoss,
    GaussianTransition,
    LinearGaussianEmission,
    PolicyStep,
)
from torchrl_drbpn.functional import innovation_weights, robust_weights
from torchrl_drbpn.functional.robust import Robust

OBS, ACTION, BATCH, TIME = 5, 2, 6, 5
MODELS = ["innovation", "information", "free", "full", "network", "propagated"]
KINDS = list(get_args(Robust))


def make(kind: str = "innovation", **options: Any) -> BeliefFilter:
    state = {"information": 3, "free": 7, "network": 3}.get(kind, OBS)
    if kind == "full":
        options["emission"] = LinearGaussianEmission(
            OBS, state, ACTION, cov="full", dtype=torch.float64
        )
    if kind == "propagated":
        options["covariance"] = kind
    network = kind == "network"
    return make_filter(OBS, ACTION, torch.float64, state, cov_network=network, **options)


def before(model: BeliefFilter) -> Tensor | None:
    """Covariance of the step before the first, where it is read."""
    if model.covariance == "constant":
        return None
    return 0.4 * torch.eye(model.state_dim, dtype=torch.float64).expand(BATCH, -1, -1)


def inputs(model: BeliefFilter, wrong: float = 0.25) -> tuple[Tensor, ...]:
    """Sequences whose readings are off in a share; row 0 has none, row 1 one; two rows start."""
    g = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    mean, action = draw(BATCH, model.state_dim), draw(BATCH, TIME, ACTION)
    observation = draw(BATCH, TIME, OBS)
    spiked = torch.rand(BATCH, TIME, OBS, generator=g) < wrong
    observation = torch.where(spiked, 30.0 * observation, observation)
    observed = torch.rand(BATCH, TIME, OBS, generator=g) < 0.8
    observed[0], observed[1] = False, torch.arange(OBS) == 2
    reset = torch.zeros(BATCH, TIME, dtype=torch.bool)
    reset[-2:, 0] = reset[2, 3] = True
    return mean, action, observation, observed, reset


def first(data: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """One step of the sequences."""
    return data[0], *(x[:, 0] for x in data[1:])


def textbook_weights(v: Tensor, S: Tensor, r: Tensor, seen: Tensor, kind: str, c: float) -> Tensor:
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


def textbook(
    model: BeliefFilter, kind: str, c: float, data: tuple[Tensor, ...]
) -> tuple[Tensor, ...]:
    """Filter by loops over rows, steps and readings: means, covariances, likelihoods, weights."""
    start, actions, observations, observeds, resets = data
    out: list[list[Tensor]] = [[], [], [], []]
    H, R = model.emission.matrix, model.emission.cov()
    for b in range(len(resets)):
        mean, cov = start[b], before(model)
        cov = None if cov is None else cov[b]
        for t in range(resets.shape[1]):
            action, x, seen = actions[b, t], observations[b, t], observeds[b, t]
            m, P = model.initial_mean, model.initial_cov
            if not resets[b, t]:
                m, P = model.transition(mean, action)
                if cov is not None:
                    F = model.mean_jacobian
                    P = (F @ cov @ F.mT).detach() + P
            offset = model.emission.action_matrix @ action + model.emission.offset
            with torch.no_grad():
                v = torch.where(seen, x - H @ m - offset, 0.0)
                w = textbook_weights(v, H @ P @ H.mT + R, R.diagonal(), seen, kind, c)
            noise = R + torch.diag(R.diagonal() * (1 / w - 1))
            ll = oracles.log_likelihood(m, P, x, seen, H, noise, offset)
            mean, filtered = oracles.update(m, P, x, seen, H, noise, offset)
            cov = None if cov is None else filtered
            for found, value in zip(out, (mean, filtered, ll, w), strict=True):
                found.append(value)
    return tuple(torch.stack(x).unflatten(0, resets.shape) for x in out)


# What the weights are -------------------------------------------------------------------------


@pytest.mark.parametrize("robust", KINDS)
@pytest.mark.parametrize("kind", MODELS)
def test_a_robust_filter_is_the_textbook_in_values_and_all_gradients(kind, robust) -> None:
    model = make(kind, robust=robust, robust_threshold=2.0)
    data = inputs(model)
    mean, *rest = data
    means, covs, likelihoods, weights = textbook(model, robust, 2.0, data)
    low = weights[data[3]] < 0.5
    assert 10 < low.sum() < len(low) - 10
    out = model(mean, before(model), *rest, return_cov=True)
    truth, found = (means, covs, likelihoods), (out.mean, out.cov, out.log_likelihood)
    for value, expected in zip(found, truth, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-7, atol=1e-7)
    gradients = [
        torch.autograd.grad(
            sum((x.sin().sum() for x in outputs), torch.zeros(())), list(model.parameters())
        )
        for outputs in (found, truth)
    ]
    for value, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", MODELS)
def test_readings_within_the_threshold_are_believed_to_the_bit(kind: str) -> None:
    model, plain = make(kind, robust="huber", robust_threshold=1e3), make(kind)
    mean, *rest = inputs(model, wrong=0.0)
    options = {"cov": before(model), "robust": "huber", "threshold": 1e3}
    weights = robust_weights(model.state_space(), *first((mean, *rest)), **options)
    assert (weights == 1).all()
    assert not weights.requires_grad
    outs = (m(mean, before(m), *rest, return_cov=True) for m in (model, plain))
    for a, b in zip(*outs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def correlated(
    off: dict[int, float], robust: str | None, n: int = 5, c: float = 3.0
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
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
    mean, cov = oracles.update(*start, x, everything, one, (r / w).diag())
    return w, mean, cov, oracles.update(*start, x, right, one, r.diag())[0]


@pytest.mark.parametrize("robust", KINDS)
def test_one_of_five_correlated_sensors_25_deviations_off_is_found(robust: str) -> None:
    """Its marginal deviation is 2.5 only; without weights it moves the belief by ten of its own."""
    w, mean, cov, right = correlated({0: 2.5}, robust)
    assert w[0] < 0.15
    assert w[1:].min() > 0.5
    assert (mean - right).abs() < 1.5 * cov.sqrt()
    believed = correlated({0: 2.5}, None)
    assert (believed[1] - right).abs() > 10 * believed[2].sqrt()
    assert cov > 1.2 * believed[2]  # the covariance knows of it


@pytest.mark.parametrize("robust", KINDS)
@pytest.mark.parametrize("n", [1, 2, 5])
def test_one_reading_moved_to_infinity_moves_the_mean_less_than_its_bound(n: int, robust) -> None:
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
def test_half_of_independent_sensors_wrong_at_once_is_withstood(robust: str) -> None:
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
def test_where_all_readings_agree_on_another_state_the_belief_follows_them(robust: str) -> None:
    w, mean, *_ = correlated(dict.fromkeys(range(5), 1e4), robust)
    assert w.min() > 0.9
    assert mean > 9e3
    model = make(robust=robust)
    _, action, observation, observed, reset = first(inputs(model, wrong=0.0))
    given = (action, observation, torch.ones_like(observed), torch.zeros_like(reset))
    lost = torch.full((BATCH, OBS), 1e4, dtype=torch.float64)
    follows, free = model.step(lost, None, *given).mean, make().step(lost, None, *given).mean
    predicted = model.predict(lost, action, torch.zeros_like(reset)).mean
    assert (follows - free).norm() < 0.2 * (predicted - free).norm()


# Acting, sequences, losses, export ------------------------------------------------------------


def frames(data: tuple[Tensor, ...], cov: Tensor | None = None) -> TensorDict:
    mean, action, observation, observed, reset = data
    stored = torch.zeros(BATCH, TIME, mean.shape[-1], dtype=torch.float64)
    stored[:, 0] = mean
    recurrent = {"mean": stored}
    if cov is not None:
        recurrent["cov"] = cov.unsqueeze(1).expand(-1, TIME, -1, -1)
    age = torch.ones(BATCH, TIME, 1, dtype=torch.int64).masked_fill(reset.unsqueeze(-1), 0)
    return TensorDict(
        observation=observation,
        observed=observed,
        previous_action=action,
        is_init=reset.unsqueeze(-1),
        recurrent=recurrent | {"age": age},
        batch_size=[BATCH, TIME],
    )


@pytest.mark.parametrize("robust", KINDS)
@pytest.mark.parametrize("kind", MODELS)
def test_one_step_at_a_time_a_module_writes_what_it_writes_of_the_sequence(kind, robust) -> None:
    model = make(kind, robust=robust, robust_threshold=2.0)
    data = frames(inputs(model), before(model)).clone()
    joint = torch.zeros(BATCH, TIME, dtype=torch.bool)
    joint[3, 2] = True  # two slices in one row: the second starts from what is stored
    for name in set(data["recurrent"].keys()) - {"age"}:
        data["recurrent", name][3, 2] += 1.5 * data["recurrent", name][0, 0]
    module = BeliefFilterModule(model, policy_input="mean_cov")
    with set_recurrent_mode(True):
        whole = module(data.clone().set("is_init", data["is_init"] | joint.unsqueeze(-1)))
    state = data[:, 0]["recurrent"]
    for t in range(TIME):
        state = state.where(~joint[:, t], data[:, t]["recurrent"])
        out = module(data[:, t].clone().set("recurrent", state))
        for key in ("features", ("belief", "log_likelihood")):
            torch.testing.assert_close(out[key], whole[key][:, t], rtol=1e-9, atol=1e-9)
        state = out["next", "recurrent"]
    plain = BeliefFilterModule(make(kind), policy_input="mean_cov")
    with set_recurrent_mode(True):
        believed = plain(data.clone())["features"]
    assert not torch.allclose(whole["features"], believed, atol=1e-2)


@pytest.mark.parametrize("kind", MODELS)
def test_a_policy_step_and_its_export_keep_the_robust_update(kind: str) -> None:
    model = make(kind, robust="huber", robust_threshold=1.0)
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


def test_the_loss_trains_the_update_that_acts() -> None:
    """The belief of the loss is the one that acted: at the parameters of acting the ratio is 1."""
    model = make("information", robust="huber", robust_threshold=2.0)
    module, data = BeliefFilterModule(model), frames(inputs(model))
    agent = make_agent(module, module.feature_dim, actions=ACTION)
    loss = DRBPNLoss(module, ClipPPOLoss(agent.actor, agent.critic), BeliefModelLoss())
    with set_recurrent_mode(True), torch.no_grad():
        acted = agent.policy(data.clone())
    for key in ("action", "action_log_prob"):
        data[key] = acted[key]
    data["advantage"], data["value_target"] = (torch.ones(BATCH, TIME, 1).double() for _ in "av")
    data["next"] = data.select("observation", "observed", "is_init")
    for key in ("done", "terminated", "reward"):
        kind = torch.float64 if key == "reward" else torch.bool
        data["next", key] = torch.zeros(BATCH, TIME, 1, dtype=kind)
    data["next", "previous_action"] = data["action"]
    with set_recurrent_mode(True):
        out = loss(data)
    assert out["kl_approx"].abs().max() < 1e-9
    assert out["ESS"].mean().item() == pytest.approx(1.0, rel=1e-9)
    (out["loss_objective"] + out["loss_model"]).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def test_float32_and_a_transition_of_your_own_have_the_weights_too() -> None:
    class Own(nn.Module):
        state_dim = OBS

        def forward(self, mean: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            del action
            return 0.9 * mean, torch.eye(OBS, dtype=mean.dtype).expand(*mean.shape, OBS)

    for transition in (Own(), GaussianTransition(OBS, ACTION)):
        model = BeliefFilter(OBS, ACTION, transition=transition, robust="imq")
        mean, action, observation, observed, reset = inputs(model)
        narrow = (mean.float(), action.float(), observation.float(), observed, reset)
        out = model(narrow[0], None, *narrow[1:])
        assert out.mean.dtype == torch.float32
        wide = textbook(model, "imq", 4.0, narrow)[0]
        torch.testing.assert_close(out.mean, wide.float(), rtol=1e-3, atol=1e-3)


# Bad values -----------------------------------------------------------------------------------


@pytest.mark.parametrize("robust", KINDS)
def test_a_nan_that_did_not_arrive_changes_nothing_and_no_gradient(robust: str) -> None:
    results = []
    for filler in (0.0, torch.nan, torch.inf):
        model = make(robust=robust)
        mean, action, observation, observed, reset = inputs(model)
        observation = torch.where(observed, observation, filler)
        out = model(mean, None, action, observation, observed, reset)
        (out.mean.square().sum() + out.log_likelihood.sum()).backward()
        gradients = [p.grad for p in model.parameters() if p.grad is not None]
        assert len(gradients) > 5
        results.append([out.mean.detach(), *gradients])
    for other in results[1:]:
        for received, expected in zip(other, results[0], strict=True):
            assert torch.equal(received, expected)


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
def test_an_error_names_its_cause_whatever_the_update(spoiled, error, message, robust) -> None:
    model = make(robust=robust)
    mean, action, observation, observed, reset = first(inputs(model))
    observed[:], reset[:] = True, False
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
def test_an_update_that_is_none_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BeliefFilter(OBS, ACTION, **options)
    model = make(robust="huber")
    for name, value in options.items():
        setattr(model, name, value)
    mean, *rest = first(inputs(model))
    with pytest.raises(ValueError, match=message):
        model.step(mean, None, *rest)
