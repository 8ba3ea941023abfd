"""Is a belief whose covariance is propagated honest in outages that its training never had?

The linear system of constant_covariance.py, its mean known; what is uncertain is learned by the
likelihood of sequences whose sensors fail independently at every step: P of the paper's constant
form, Q of the propagated one (P = F cov F' + Q, F and cov without gradient). Both are then tested
where sensors fail for 20 or 50 steps on average, one by one or all at once; diagonal: the
propagated one with its variances alone. MSE of the state over that of the exact filter, NEES / n
(1: as sure as it should be), plus-minus 1.96 standard errors over sequences. ``--quick`` only
shows that it runs.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import pandas as pd
from constant_covariance import STATE, dynamics, judge, ratio, simulate, system, trained_cov

TRAINED = (0.5, 2.0, False)
TESTED = {
    f"{'all at once' if together else 'each'}, mean length {length:.0f}": (0.5, length, together)
    for together in (False, True)
    for length in (20.0, 50.0)
}


def main(quick: bool = False) -> None:
    """Print the table of docs/calibration.md."""
    rows, time, iterations = (8, 20, 3) if quick else (200, 200, 200)
    model = system()
    _, observation, observed = simulate(model, TRAINED, rows, time, seed=0)
    constant = trained_cov(model, observation, observed, iterations)
    A = dynamics(model)
    propagated = trained_cov(
        replace(model, transition_jacobian=A), observation, observed, iterations
    )
    found = {}
    for name, case in TESTED.items():
        data = simulate(model, case, rows, time, seed=1)
        exact = judge(model, model.transition_cov, *data, propagated=True)
        row = {"NEES / n, exact": ratio(exact["nees"], exact["entries"])}
        for label, Q in (
            ("constant", constant), ("propagated", propagated), ("diagonal", propagated),
        ):  # fmt: skip
            given = {"propagated": label != "constant", "diagonal": label == "diagonal"}
            sums = judge(model, Q, *data, **given)
            row[f"MSE over exact, {label}"] = ratio(sums["se"], exact["se"])
            row[f"NEES / n, {label}"] = ratio(sums["nees"], sums["entries"])
        found[name] = row
    print(f"{rows} sequences of {time} steps, {STATE} states")
    print(pd.DataFrame(found).T.to_string())


if __name__ == "__main__":
    main("--quick" in sys.argv)
