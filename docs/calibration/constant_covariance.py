"""What does the paper's constant predicted covariance cost, and how well is it calibrated?

A known linear system, four sensors with noise, and two filters that know everything about it but
one thing: the exact filter propagates its covariance (P = A Sigma A' + Q), the other predicts with
the same P at every step, as eq. (8) of the paper does, and that P is trained by likelihood on data
with the same gaps. MSE of the state over the exact filter's; NEES / n and NIS / entries, 1 for a
filter that is as sure as it should be. Sensors fail one by one, independently at every step or for
20 steps on average, or all at once. Each sensor shows one component of the state, so NEES / n is
told by the steps since a component was last seen as well, in the classes of diagnose.py: of the
sub-vector of the components in a class, 0 for those that have just arrived. Plus-minus: 1.96
standard errors over independent sequences. ``--quick`` only shows that it runs.
"""

from __future__ import annotations

import itertools
import math
import sys
from dataclasses import replace

import pandas as pd
import torch
from torch import Tensor

from torchrl_drbpn.functional import (
    Belief,
    StateSpace,
    TransitionMLP,
    filter_sequence,
    full_cov,
    innovation,
    nees,
    nis,
    outage_rates,
    predict,
    sample_working,
    update,
)

STATE, MIN_STD = 4, 1e-3
# Where the classes of steps since last seen begin, those of conf/diagnose.yaml.
BINS = (1, 2, 3, 4, 5, 6, 11, 21, 51)
FEWEST = 30  # components of a class that is told
CASES = {
    "each sensor, 50 % of the steps, independent": (0.5, 2.0, False),
    "each sensor, 50 %, outages of mean length 20": (0.5, 20.0, False),
    "all sensors at once, 50 %, mean length 20": (0.5, 20.0, True),
}


def system() -> StateSpace:
    """Build two damped oscillators that pull at each other, seen component by component."""

    def turn(angle: float) -> Tensor:
        c, s = math.cos(angle), math.sin(angle)
        return torch.tensor([[c, s], [-s, c]], dtype=torch.float64)

    A = torch.block_diag(0.96 * turn(0.3), 0.93 * turn(0.8))
    A[0, 3] = A[2, 1] = 0.05
    eye = torch.eye(STATE, dtype=torch.float64)
    Q, R = 0.3**2 * eye, torch.full((STATE,), 0.2**2, dtype=torch.float64)
    stationary = Q.clone()
    for _ in range(1000):
        stationary = A @ stationary @ A.mT + Q
    zero = torch.zeros(STATE, dtype=torch.float64)
    weight = torch.cat([A, torch.zeros(STATE, 1, dtype=torch.float64)], -1)
    f = TransitionMLP((weight,), (zero,), False, "relu")
    return StateSpace(f, Q, eye, R, torch.zeros(STATE, 1, dtype=torch.float64), zero, zero,
                      stationary)  # fmt: skip


def dynamics(model: StateSpace) -> Tensor:
    """Return A."""
    assert isinstance(model.transition, TransitionMLP)
    return model.transition.weights[0][:, :STATE]


def simulate(
    model: StateSpace, case: tuple[float, float, bool], rows: int, time: int, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw states, observations and masks, each (rows, time, ...)."""
    g = torch.Generator().manual_seed(seed)

    def normal(cov: Tensor) -> Tensor:
        noise = torch.randn(rows, STATE, generator=g, dtype=torch.float64)
        return noise @ torch.linalg.cholesky(cov).mT

    eta, length, together = case
    rates = outage_rates(eta, length)
    like = torch.zeros(rows, 1 if together else STATE)
    A, R = dynamics(model), model.full_emission_cov()
    state, working = normal(model.initial_cov), sample_working(None, rates, like, g)
    states, seen, masks = [], [], []
    for t in range(time):
        if t:
            assert isinstance(model.transition_cov, Tensor)
            state = state @ A.mT + normal(model.transition_cov)
            working = sample_working(working, rates, like, g)
        states.append(state)
        seen.append(state + normal(R))
        masks.append(working.expand(rows, STATE))
    return torch.stack(states, 1), torch.stack(seen, 1), torch.stack(masks, 1)


def trained_cov(
    model: StateSpace, observation: Tensor, observed: Tensor, iterations: int
) -> Tensor:
    """Return the constant P under which what arrived is likeliest."""
    assert isinstance(model.transition_cov, Tensor)
    raw = torch.linalg.cholesky(model.transition_cov).requires_grad_()
    optimiser = torch.optim.Adam([raw], lr=0.05)
    rows, time = observed.shape[:2]
    reset = torch.zeros(rows, time, dtype=torch.bool)
    reset[:, 0] = True
    action = torch.zeros(rows, time, 1, dtype=torch.float64)
    for _ in range(iterations):
        learned = replace(model, transition_cov=full_cov(raw, MIN_STD))
        start = model.initial_mean.expand(len(observation), -1)
        given = {} if model.transition_jacobian is None else {"cov": model.full_initial_cov()}
        cov = {k: x.expand(len(observation), -1, -1) for k, x in given.items()}
        out = filter_sequence(learned, start, action, observation, observed, reset, **cov)
        optimiser.zero_grad()
        (-out.log_likelihood.sum() / observed.sum()).backward()
        optimiser.step()
    return full_cov(raw, MIN_STD).detach()


def class_names() -> list[str]:
    """Name the classes of components: 0 for those that have just arrived."""
    ends = itertools.pairwise(BINS)
    within = [str(low) if high == low + 1 else f"{low}-{high - 1}" for low, high in ends]
    return ["0", *within, f"{BINS[-1]}+", "never"]


def judge(
    model: StateSpace,
    Q: Tensor,
    state: Tensor,
    observation: Tensor,
    observed: Tensor,
    *,
    propagated: bool,
    diagonal: bool = False,
) -> dict[str, Tensor]:
    """Filter with P = Q or P = A P A' + Q, and return sums for each sequence (and class).

    ``diagonal`` keeps the variances alone of every P: those are (A o A) P + Q then.
    """
    rows, time = observed.shape[:2]
    A, R = dynamics(model), model.full_emission_cov()
    action, zero = torch.zeros(rows, 1, dtype=torch.float64), model.emission_offset
    belief = Belief(
        model.initial_mean.expand(rows, -1), model.initial_cov.expand(rows, STATE, STATE)
    )
    sums = {name: torch.zeros(rows, dtype=torch.float64) for name in ("se", "nees", "nis", "dof")}
    never = len(BINS) + 1
    for name in ("nees by class", "components by class"):
        sums[name] = torch.zeros(rows, never + 1, dtype=torch.float64)
    edges, since = torch.tensor(BINS), torch.zeros(rows, STATE, dtype=torch.int64)
    ever = torch.zeros(rows, STATE, dtype=torch.bool)
    for t in range(time):
        if t:
            belief = predict(
                belief, lambda m, _: m @ A.mT, Q, action, jacobian=A if propagated else None
            )
        if diagonal:
            belief = belief._replace(cov=belief.cov.diagonal(dim1=-2, dim2=-1).diag_embed())
        seen = observed[:, t]
        given = (observation[:, t], seen, model.emission_matrix, R, zero.expand(rows, -1))
        sums["nis"] += nis(*innovation(belief, *given), seen)
        sums["dof"] += seen.sum(-1)
        belief = update(belief, *given)
        error = state[:, t] - belief.mean
        sums["se"] += error.square().sum(-1)
        sums["nees"] += nees(error, belief.cov)
        gap = torch.bucketize(since + 1, edges, right=True)
        kind = torch.where(seen, 0, torch.where(ever, gap, never))
        ever, since = ever | seen, torch.where(seen, 0, since + 1)
        for index in kind.unique().tolist():
            chosen = kind == index
            sums["nees by class"][:, index] += nis(error, belief.cov, chosen)
            sums["components by class"][:, index] += chosen.sum(-1)
    return sums | {"entries": torch.full((rows,), float(STATE * time), dtype=torch.float64)}


def ratio(numerator: Tensor, denominator: Tensor) -> str:
    """Return a ratio of sums over sequences and 1.96 standard errors of it."""
    value = numerator.sum() / denominator.sum()
    error = (numerator - value * denominator).std() * math.sqrt(len(numerator)) / denominator.sum()
    return f"{value:.2f} +- {1.96 * error:.2f}"


def by_class(found: dict[str, Tensor]) -> dict[str, str]:
    """Return NEES over components of every class that the data holds."""
    nees, count = found["nees by class"], found["components by class"]
    return {
        name: ratio(nees[:, i], count[:, i])
        for i, name in enumerate(class_names())
        if count[:, i].sum() >= FEWEST
    }


def main(quick: bool = False) -> None:
    """Print both tables of docs/calibration.md."""
    rows, time, iterations = (8, 20, 3) if quick else (200, 200, 200)
    model = system()
    assert isinstance(model.transition_cov, Tensor)
    averages, classes = {}, {}
    for name, case in CASES.items():
        _, observation, observed = simulate(model, case, rows, time, seed=0)
        cov = trained_cov(model, observation, observed, iterations)
        data = simulate(model, case, rows, time, seed=1)
        filters = {
            "constant": judge(model, cov, *data, propagated=False),
            "exact": judge(model, model.transition_cov, *data, propagated=True),
            # What a P that was trained as the whole covariance gives where it is taken for Q.
            "constant, propagated": judge(model, cov, *data, propagated=True),
        }
        mse = ratio(filters["constant"]["se"], filters["exact"]["se"])
        averages[name] = {"MSE, constant over exact": mse} | {
            f"{what}, {label}": ratio(found[what], found[per])
            for what, per in (("nees", "entries"), ("nis", "dof"))
            for label, found in filters.items()
        }
        for label in ("constant", "exact"):
            classes[name, label] = by_class(filters[label])
    print(pd.DataFrame(averages).to_string())
    print("\nNEES / n by steps since last seen")
    print(pd.DataFrame(classes).reindex(class_names()).fillna("").to_string())


if __name__ == "__main__":
    main("--quick" in sys.argv)
