"""The robust update: the bound on innovations in the filter, its module and its export.

Specified here, in float64: readings are moved as the textbook's loop over entries moves them, first
steps, missing entries and every kind of model included; a reading within the bound is unchanged;
belief and gradient do not depend on how far off a single wrong reading is; where most readings are
far off the belief follows them; without a gate nothing changes. The command line:
test_evaluate.py.
"""

from __future__ import annotations

import statistics
from typing import Any

import oracles
import pytest
import torch
from small_agents import make_filter
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import (
    BeliefDivergedError,
    BeliefFilter,
    BeliefFilterModule,
    GaussianTransition,
    LinearGaussianEmission,
    PolicyStep,
)
from torchrl_drbpn.functional import saturate_innovation

OBS, ACTION, BATCH = 5, 2, 12
MODELS = ["innovation", "information", "free", "full", "network"]


def make(kind: str = "innovation") -> BeliefFilter:
    state = {"information": 3, "free": 7, "network": 3}.get(kind, OBS)
    emission = None
    if kind == "full":
        emission = LinearGaussianEmission(OBS, state, ACTION, cov="full", dtype=torch.float64)
    return make_filter(
        OBS, ACTION, torch.float64, state, cov_network=kind == "network", emission=emission
    )


def inputs(model: BeliefFilter, wrong: float = 0.25) -> tuple[Tensor, ...]:
    """A share of the readings is far off; row 0 has none, row 1 one; two rows start."""
    g = torch.Generator().manual_seed(0)
    mean = torch.randn(BATCH, model.state_dim, generator=g, dtype=torch.float64)
    action = torch.randn(BATCH, ACTION, generator=g, dtype=torch.float64)
    observation = torch.randn(BATCH, OBS, generator=g, dtype=torch.float64)
    spiked = torch.rand(BATCH, OBS, generator=g) < wrong
    observation = torch.where(spiked, 30.0 * observation, observation)
    observed = torch.rand(BATCH, OBS, generator=g) < 0.8
    observed[0], observed[1] = False, torch.arange(OBS) == 2
    reset = torch.arange(BATCH) >= BATCH - 2
    return mean, action, observation, observed, reset


def forecast(model: BeliefFilter, mean: Tensor, action: Tensor, reset: Tensor) -> Any:
    """Of one row: predicted mean and covariance, expected readings, their variances, by entry."""
    m, P = (model.initial_mean, model.initial_cov) if reset else model.transition(mean, action)
    H, R = model.emission.matrix, model.emission.cov()
    offset = model.emission.action_matrix @ action + model.emission.offset
    expected = torch.stack([H[i] @ m + offset[i] for i in range(OBS)])
    variance = torch.stack([H[i] @ P @ H[i] + R[i, i] for i in range(OBS)])
    return m, P, H, R, offset, expected, variance


def by_hand(model: BeliefFilter, gate: float, data: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Saturate entry by entry in Python, then update with the rows of missing entries deleted."""
    readings, means, likelihoods = [], [], []
    for mean, action, x, seen, reset in zip(*data, strict=True):
        m, P, H, R, offset, expected, variance = forecast(model, mean, action, reset)
        score = ((x - expected).abs() / variance.sqrt()).tolist()
        arrived = [score[i] for i in range(OBS) if seen[i]]
        c = max(1.0, statistics.median_low(arrived) / 0.67448975) if arrived else 1.0
        moved = x.clone()
        for i in range(OBS):
            if seen[i] and score[i] > gate * c:
                sign = 1.0 if x[i] > expected[i] else -1.0
                moved[i] = expected[i] + sign * gate * c * variance[i].sqrt()
        readings.append(torch.where(seen, moved, 0.0))
        means.append(oracles.update(m, P, moved, seen, H, R, offset)[0])
        likelihoods.append(oracles.log_likelihood(m, P, moved, seen, H, R, offset))
    return torch.stack(readings), torch.stack(means), torch.stack(likelihoods)


# Values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("gate", [0.5, 2.0])
@pytest.mark.parametrize("kind", MODELS)
def test_a_robust_step_is_the_textbook_on_saturated_readings(kind: str, gate: float) -> None:
    model = make(kind)
    data = inputs(model)
    mean, action, observation, observed, reset = data
    readings, means, likelihoods = by_hand(model, gate, data)
    moved = ((readings != observation) & observed).sum()
    assert 3 < moved < observed.sum()  # some are, some are not
    x = saturate_innovation(model.state_space(), *data, gate)
    torch.testing.assert_close(torch.where(observed, x, 0.0), readings, rtol=1e-7, atol=1e-7)
    out = model.step(mean, None, action, observation, observed, reset, gate=gate)
    torch.testing.assert_close(out.mean, means, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(out.log_likelihood, likelihoods, rtol=1e-7, atol=1e-6)


def test_a_reading_within_the_bound_is_unchanged_to_the_bit() -> None:
    model = make()
    mean, action, observation, observed, reset = inputs(model)
    out = saturate_innovation(model.state_space(), mean, action, observation, observed, reset, 1e3)
    assert torch.equal(out[observed], observation[observed])


def spiked(error: float) -> tuple[BeliefFilter, tuple[Tensor, ...]]:
    """Readings as predicted but one of five, which is ``error`` off."""
    model = make()
    mean, action, observation, observed, reset = inputs(model)
    for row in range(BATCH):
        observation[row] = forecast(model, mean[row], action[row], reset[row])[5].detach()
    observation[:, 1] += error
    return model, (mean, action, observation, torch.ones_like(observed), reset)


def test_how_far_off_a_wrong_reading_is_makes_no_difference() -> None:
    results = []
    for error in (1e2, 1e6):
        model, (mean, action, observation, observed, reset) = spiked(error)
        readings = observation.clone().requires_grad_()
        out = model.step(mean, None, action, readings, observed, reset, gate=3.0)
        out.mean.square().sum().backward()
        assert readings.grad is not None
        assert not readings.grad[:, 1].any()
        assert readings.grad[:, 0].all()
        results.append((out.mean.detach(), model.initial_mean.grad))
    for near, far in zip(*results, strict=True):
        torch.testing.assert_close(near, far, rtol=1e-9, atol=1e-9)
    right = spiked(0.0)[1]
    predicted = model.step(mean, None, action, right[2], observed, reset).mean
    believed = model.step(mean, None, action, observation, observed, reset).mean
    assert (results[1][0] - predicted).norm() < 1e-4 * (believed - predicted).norm()


def test_where_most_readings_are_far_off_the_belief_follows_them() -> None:
    """Beliefs wrong by 1e4: with every sensor agreeing, one step brings them near the readings."""
    model = make()
    mean, action, observation, observed, reset = inputs(model, wrong=0.0)
    everything, going_on = torch.ones_like(observed), torch.zeros_like(reset)
    wrong = torch.full_like(mean, 1e4)
    gated = model.step(wrong, None, action, observation, everything, going_on, gate=3.0)
    free = model.step(wrong, None, action, observation, everything, going_on)
    lost = model.predict(wrong, action, going_on).mean
    assert (gated.mean - free.mean).norm() < 0.1 * (lost - free.mean).norm()


# Gradients, bad values ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["innovation", "information", "network"])
def test_gradients_agree_with_finite_differences(kind: str) -> None:
    model = make(kind)
    mean, action, observation, observed, reset = inputs(model)

    def step(mean: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        out = model.step(mean, None, action, observation, observed, reset, gate=1.0)
        return out.mean, out.log_likelihood

    assert torch.autograd.gradcheck(step, (mean.requires_grad_(), observation.requires_grad_()))


def test_a_nan_that_did_not_arrive_changes_nothing_and_no_gradient() -> None:
    results = []
    for filler in (0.0, torch.nan, torch.inf):
        model = make()
        mean, action, observation, observed, reset = inputs(model)
        observation = torch.where(observed, observation, filler)
        out = model.step(mean, None, action, observation, observed, reset, gate=1.0)
        (out.mean.square().sum() + out.log_likelihood.sum()).backward()
        gradients = [p.grad for p in model.parameters() if p.grad is not None]
        assert len(gradients) > 5
        results.append([out.mean.detach(), *gradients])
    for other in results[1:]:
        for received, expected in zip(other, results[0], strict=True):
            assert torch.equal(received, expected)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf])
def test_a_reading_that_is_not_finite_is_refused(wrong: float) -> None:
    model = make()
    mean, action, observation, observed, reset = inputs(model)
    observation[2, 3], observed[2, 3] = wrong, True
    with pytest.raises(ValueError, match=r"`observation` holds (NaN|infinite) .*components \[3\]"):
        model.step(mean, None, action, observation, observed, reset, gate=3.0)


@pytest.mark.parametrize("gate", [0.0, -1.0, float("inf"), float("nan"), True, "3"])
def test_a_gate_that_is_no_positive_number_is_refused(gate: Any) -> None:
    model = make()
    with pytest.raises(ValueError, match="`gate` must be a positive, finite number"):
        BeliefFilterModule(model, gate=gate)
    module = BeliefFilterModule(model)
    with pytest.raises(ValueError, match="`gate` must be a positive, finite number"):
        module.gate = gate
    assert module.gate is None


# With keys ------------------------------------------------------------------------------------


def frames(model: BeliefFilter) -> TensorDict:
    """The inputs as a module reads them."""
    mean, action, observation, observed, reset = inputs(model)
    return TensorDict(
        {
            "observation": observation,
            "observed": observed,
            "previous_action": action,
            "is_init": reset.unsqueeze(-1),
            "recurrent": {"mean": mean, "age": torch.where(reset, 0, 3).unsqueeze(-1)},
        },
        [BATCH],
    )


def test_the_module_filters_with_its_gate_or_without_one() -> None:
    model = make()
    data = inputs(model)
    module = BeliefFilterModule(model, gate=1.0)
    mean, action, observation, observed, reset = data
    for gate in (1.0, None):
        module.gate = gate
        expected = model.step(mean, None, action, observation, observed, reset, gate=gate)
        out = module(frames(model))
        assert torch.equal(out["features"], expected.mean)
        assert torch.equal(out["next", "recurrent", "mean"], expected.mean)
    saturated = by_hand(model, 1.0, data)[1]
    assert not torch.allclose(out["features"], saturated, atol=1e-3)


def test_over_sequences_a_gate_is_refused() -> None:
    model = make()
    module = BeliefFilterModule(model, gate=3.0)
    with (
        set_recurrent_mode(True),
        pytest.raises(ValueError, match=r"`gate` is 3, and the mode is recurrent.*gate = None"),
    ):
        module(frames(model).unsqueeze(0))


@pytest.mark.parametrize("kind", MODELS)
def test_a_policy_step_and_its_export_keep_the_gate(kind: str) -> None:
    model = make(kind)
    module = BeliefFilterModule(model, gate=1.0)
    step = PolicyStep(module, nn.Linear(module.feature_dim, ACTION, dtype=torch.float64))
    module.gate = None  # the step is a copy
    mean, action, observation, observed, reset = inputs(model)
    age = torch.where(reset, 0, 3).unsqueeze(-1)
    args = (observation, observed, action, reset.unsqueeze(-1), mean, age)
    expected = model.step(mean, None, action, observation, observed, reset, gate=1.0).mean
    believed = model.step(mean, None, action, observation, observed, reset).mean
    torch.testing.assert_close(step(*args)[1], expected, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(believed, expected, atol=1e-3)
    if kind == "innovation":
        exported = torch.export.export(step, args).module()
        torch.testing.assert_close(exported(*args), step(*args))


def test_a_gate_works_in_float32_and_with_another_transition() -> None:
    class Own(nn.Module):
        state_dim = OBS

        def forward(self, mean: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            del action
            return 0.9 * mean, torch.eye(OBS).expand(*mean.shape, OBS)

    for transition in (Own(), GaussianTransition(OBS, ACTION)):
        model = BeliefFilter(OBS, ACTION, transition=transition)
        mean, action, observation, observed, reset = inputs(model)
        narrow = (mean.float(), None, action.float(), observation.float(), observed, reset)
        out = model.step(*narrow, gate=1.0)
        wide = by_hand(model, 1.0, (mean.float(), *narrow[2:]))[1]
        assert out.mean.dtype == torch.float32
        torch.testing.assert_close(out.mean, wide.float(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("gate", [None, 3.0])
@pytest.mark.parametrize(
    ("spoiled", "error", "message"),
    [
        ("model", BeliefDivergedError, "the learned model diverged"),
        ("mean", ValueError, "`mean` holds NaN"),
        ("action", ValueError, "`previous_action` holds NaN"),
        ("observation", ValueError, "`observation` holds NaN"),
    ],
)
def test_an_error_names_its_cause_with_and_without_a_gate(spoiled, error, message, gate):
    model = make()
    mean, action, observation, observed, reset = inputs(model)
    observed[:], reset[:] = True, False
    with torch.no_grad():
        if spoiled == "model":
            for name, parameter in model.transition.named_parameters():
                if name.endswith("weight"):
                    parameter.fill_(torch.inf)
        else:
            {"mean": mean, "action": action, "observation": observation}[spoiled][3] = torch.nan
    with pytest.raises(error, match=message):
        model.step(mean, None, action, observation, observed, reset, gate=gate)
