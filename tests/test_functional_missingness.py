"""The laws of missingness, outages, noise and spikes, within a few standard errors."""

import itertools
import math

import pytest
import torch
from refusals import refuses

from torchrl_drbpn import functional as F

OBS, ACTION = 9, 3


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def mechanism(kind, seed=0, **kwargs):
    return F.draw_mechanism(kind, OBS, ACTION, generator=seeded(seed), **kwargs)


def example(batch=(4,), seed=5):
    generator = seeded(seed)
    x = torch.randn(*batch, OBS, generator=generator, dtype=torch.float64)
    return x, torch.randn(*batch, ACTION, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(
    ("obs", "share", "count"),
    [(17, 0.25, 4), (11, 0.25, 3), (27, 0.25, 7), (4, 0.0, 1), (4, 0.8, 3)],
)
def test_the_number_of_always_observed_entries_is_the_rounded_share_and_at_least_one(
    obs, share, count
):
    drawn = F.draw_mechanism("mar", obs, ACTION, always_observed=share, generator=seeded())
    assert int(drawn.always_observed.sum()) == count


def test_mar_and_nmar_share_their_numbers():
    mar, nmar = mechanism("mar"), mechanism("nmar")
    assert torch.equal(mar.always_observed, nmar.always_observed)
    assert torch.equal(mar.bias, nmar.bias)
    assert torch.equal(mar.action_weight, nmar.action_weight)
    always = mar.always_observed
    assert torch.equal(mar.observation_weight[:, always], nmar.observation_weight[:, always])
    assert (mar.observation_weight[:, ~always] == 0).all()
    assert (nmar.observation_weight[:, ~always] != 0).all()


def test_weights_are_standard_normal():
    drawn = F.draw_mechanism("nmar", 120, 40, generator=seeded())
    for part in (drawn.bias[~drawn.always_observed], drawn.observation_weight, drawn.action_weight):
        n = part.numel()
        assert abs(part.mean()) < 3.5 / math.sqrt(n)
        assert abs(part.var() - 1) < 3.5 * math.sqrt(2 / n)


@pytest.mark.parametrize("kind", ["mar", "nmar"])
@pytest.mark.parametrize("eta", [0.0, 0.3, 1.0])
def test_probabilities_are_the_formula_entry_by_entry(kind, eta):
    drawn, (x, action) = mechanism(kind), example((2, 3))
    probability = F.missing_probability(drawn, x, action, eta)
    assert probability.shape == x.shape
    for row, column, i in itertools.product(range(2), range(3), range(OBS)):
        logit = float(drawn.bias[i])
        for j in range(ACTION):
            logit += float(drawn.action_weight[i, j] * action[row, column, j])
        for j in range(OBS):
            if kind == "nmar" or drawn.always_observed[j]:
                logit += float(drawn.observation_weight[i, j] * x[row, column, j])
        expected = 0.0 if drawn.always_observed[i] else min(1 / (1 + math.exp(-logit)), eta)
        assert float(probability[row, column, i]) == pytest.approx(expected, abs=1e-12)


def test_no_previous_action_is_the_zero_action():
    x, action = example()
    drawn = mechanism("nmar")
    none = F.missing_probability(drawn, x, None, 0.9)
    assert torch.equal(none, F.missing_probability(drawn, x, torch.zeros_like(action), 0.9))
    assert not torch.equal(none, F.missing_probability(drawn, x, action, 0.9))


@pytest.mark.parametrize("eta", [0.05, 0.3, 0.9])
def test_the_realised_ratio_of_mcar_is_eta(eta):
    missing = 1 - F.sample_mask(eta, torch.zeros(10_000, OBS), seeded(1)).double()
    error = math.sqrt(eta * (1 - eta) / len(missing))
    assert ((missing.mean(0) - eta).abs() < 4 * error).all()
    # and entries go missing independently
    assert (torch.corrcoef(missing.T) - torch.eye(OBS)).abs().max() < 0.045


def test_masks_and_hits_depend_on_the_generator_and_not_on_the_dtype():
    x = torch.zeros(50, OBS)
    for draw in (
        lambda x, seed: F.sample_mask(0.5, x, seeded(seed)),
        lambda x, seed: F.sample_spikes(0.2, float(x.numel()), x, seeded(seed))[1],
    ):
        assert torch.equal(draw(x, 6), draw(x.double(), 6))
        assert not torch.equal(draw(x, 6), draw(x, 7))


def test_a_nan_is_not_hidden_by_the_mask_that_it_would_upset():
    x, action = example()
    x[0, 0] = math.nan
    observed = F.sample_mask(F.missing_probability(mechanism("nmar"), x, action, 0.5), x, seeded())
    assert observed[0].all()


def test_noise_has_mean_zero_and_the_given_standard_deviation():
    std = torch.tensor([0.0, 0.1, 3.0], dtype=torch.float64)
    noise = F.sample_noise(std, torch.zeros(40_000, 3, dtype=torch.float64), seeded(8))
    assert noise.dtype == torch.float64
    assert (noise[:, 0] == 0).all()
    assert (noise.mean(0).abs() <= 4 * std / math.sqrt(40_000)).all()
    assert ((noise.std(0) - std).abs() <= 4 * std / math.sqrt(2 * 40_000)).all()


def chain(eta, mean_length, steps, sensors, seed=0):
    """Return which sensors work, shape (steps, sensors), from the stationary start."""
    rates, generator = F.outage_rates(eta, mean_length), seeded(seed)
    like = torch.zeros(sensors)
    rows = [F.sample_working(None, rates, like, generator)]
    for _ in range(steps - 1):
        rows.append(F.sample_working(rows[-1], rates, like, generator))
    return torch.stack(rows)


def runs_of(column, value):
    """Return the lengths of the whole runs of `value`: those cut by an end are left out."""
    values, lengths = column[1:-1].unique_consecutive(return_counts=True)
    keep = values == value
    keep[[0, -1]] = False
    return lengths[keep].tolist()


@pytest.mark.parametrize(("eta", "mean_length"), [(0.5, 5.0), (0.2, 3.0)])
def test_outages_last_a_geometric_number_of_steps(eta, mean_length):
    working = chain(eta, mean_length, 3000, 20)
    for value, mean in ((False, mean_length), (True, mean_length * (1 - eta) / eta)):
        runs = torch.tensor(
            [n for column in working.T for n in runs_of(column, value)], dtype=torch.float64
        )
        # geometric on 1, 2, ... with success 1/mean: variance mean (mean - 1)
        error = math.sqrt(mean * (mean - 1) / len(runs))
        assert abs(runs.mean() - mean) < 4 * error
        for length in (1, 2, 5):
            law = (1 - 1 / mean) ** (length - 1) / mean
            share = (runs == length).double().mean()
            assert abs(share - law) < 4 * math.sqrt(law * (1 - law) / len(runs)), length


@pytest.mark.parametrize(("eta", "mean_length"), [(0.4, 1), (0.4, 5), (0.4, 50), (0.8, 4), (0, 3)])
def test_every_step_of_the_chain_misses_eta_from_the_first_on(eta, mean_length):
    working = chain(eta, mean_length, 30, 20_000)
    missing = 1 - working.double().mean(1)
    assert ((missing - eta).abs() <= 4.5 * math.sqrt(eta * (1 - eta) / 20_000)).all()


def test_spikes_hit_with_their_probability_and_have_their_deviation():
    probability = torch.tensor([0.0, 0.05, 1.0])
    std = torch.tensor([3.0, 20.0, 0.5], dtype=torch.float64)
    like = torch.zeros(40_000, 3, dtype=torch.float64)
    error, hit = F.sample_spikes(probability, std, like, seeded(8))
    assert error.dtype == torch.float64
    assert torch.equal(error != 0, hit)
    off = hit.double().mean(0) - probability
    assert (off.abs() <= 4 * (probability * (1 - probability) / 40_000).sqrt()).all()
    for i in (1, 2):
        values = error[hit[:, i], i]
        assert abs(values.mean()) < 4 * std[i] / math.sqrt(len(values))
        assert abs(values.std() - std[i]) < 4 * std[i] / math.sqrt(2 * len(values))


LEAVES = "`always_observed` must be a share that leaves an entry that can go miss"


test_numbers_that_no_law_has_are_refused = refuses(
    *(
        (lambda share=share: mechanism("mar", always_observed=share), LEAVES)
        for share in (-0.1, 0.95, 1.0, 1.1, math.nan)
    ),
    (lambda: F.draw_mechanism("mar", 1, 2, always_observed=0.0, generator=seeded()), LEAVES),
    (lambda: mechanism("mcar"), '`kind` must be "mar" or "nmar"'),
    (lambda: F.outage_rates(1.0, 5), r"`eta` must be a share of time in \[0, 1\), got 1.0"),
    (lambda: F.outage_rates(-0.1, 5), "`eta` must be a share"),
    (lambda: F.outage_rates(math.nan, 5), "`eta` must be a share"),
    (lambda: F.outage_rates(0.5, 0.9), "`mean_length` must be the mean length of an outage in"),
    (lambda: F.outage_rates(0.5, math.inf), "`mean_length` must be the mean length"),
    (lambda: F.outage_rates(0.8, 3.9), r"at least eta / \(1 - eta\) = 4 steps for eta 0.8"),
)
