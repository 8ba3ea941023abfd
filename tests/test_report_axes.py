"""The report of a study with an axis beside task, method and seed, such as the learning rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

# Puts recipes/ on the path, so it comes first.
from report_tools import make_run, quantity, report, table  # isort: skip

from analysis.report_cells import margin
from analysis.report_variants import mark_best


def test_an_axis_of_its_own_gets_a_table_with_the_best_of_each_line(tmp_path: Path) -> None:
    """Two methods, three learning rates: a mean for each, side by side, in order of size."""
    returns = {
        "drbpn": {"lr1e-3": 30.0, "lr5e-4": 50.0, "lr2.5e-4": 40.0},
        "none": {"lr1e-3": 60.0, "lr5e-4": 20.0},
    }
    for method, by_rate in returns.items():
        for rate, final in by_rate.items():
            overrides = (f"belief={method}", f"optim.lr={rate[2:]}")
            name = tmp_path / "runs" / f"{rate}-{method}"
            make_run(name, *overrides, final=final, method=method, rate=rate, points=False)
    out = tmp_path / "out"
    report(str(tmp_path / "runs" / "*"), out)
    page = (out / "README.md").read_text()
    lines = page.split("## By rate\n")[1].split("\n## ")[0].strip().splitlines()
    assert [line for line in lines if line.startswith("|")] == [
        "| task | method | seeds | steps | `lr2.5e-4` | `lr5e-4` | `lr1e-3` |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        "| Hopper-v4 | `drbpn` | 0 | 400 | 40.00 | **50.00** | 30.00 |",
        "| Hopper-v4 | `none` | 0 | 400 |  | 20.00 | **60.00** |",
    ]
    row = quantity(out, "training return", method="none", variant="lr1e-3")
    assert (row["mean"], row["per_seed"]) == ("60", "0=60")
    margins = {(r["trained_on"].split(", ")[-1], r["margin"]) for r in table(out / "margins.csv")}
    assert margins == {("lr1e-3", "-0.5"), ("lr5e-4", "1.5")}  # at the same rate


def test_choices_of_an_axis_are_means_over_seeds_and_a_run_under_way_is_not_the_best(
    tmp_path: Path,
) -> None:
    for rate, finals in {"lr5e-4": (10.0, 30.0), "lr1e-3": (40.0, 60.0), "lr2e-3": (90.0,)}.items():
        for seed, final in enumerate(finals):
            under_way = {"frames": [100, 200]} if rate == "lr2e-3" else {}
            name = tmp_path / "runs" / f"{rate}-s{seed}"
            words = f"optim.lr={rate[2:]}"
            make_run(name, words, seed=seed, final=final, method="m", rate=rate, **under_way)
    report(str(tmp_path / "runs" / "*"), tmp_path / "out", unfinished=True)
    page = (tmp_path / "out" / "README.md").read_text()
    (line,) = (line for line in page.splitlines() if line.startswith("| Hopper-v4 | `m` | 0, 1 |"))
    cells = [cell.strip() for cell in line.split("|")[5:-1]]
    # Of two runs there are four resamples: 2.5 % lies .075 of the way from the first to the second.
    assert cells == ["20.00 [10.00, 30.00]", "**50.00 [40.00, 60.00]**", "90.00 at 200 steps"]


def test_an_axis_that_decides_the_corruption_is_a_table_too(tmp_path: Path) -> None:
    for ratio in ("0.2", "0.5"):
        words = ("missingness=mcar", f"missingness.eta={ratio}")
        make_run(tmp_path / "runs" / ratio, *words, method="m", missing=f"mcar{ratio}")
    report(str(tmp_path / "runs" / "*"), tmp_path / "out")
    page = (tmp_path / "out" / "README.md").read_text()
    assert "## By missing\n" in page
    assert "| task | method | seeds | steps | `mcar0.2` | `mcar0.5` |" in page


def test_a_study_without_a_further_axis_has_neither_the_table_nor_the_column(
    tmp_path: Path,
) -> None:
    report([make_run(tmp_path / "run")], tmp_path / "out")
    assert "## By" not in (tmp_path / "out" / "README.md").read_text()
    assert "variant" not in table(tmp_path / "out" / "summary.csv")[0]


def test_the_best_of_a_line_are_finished_cells_ties_among_them() -> None:
    def cell(iqm: float | None, finished: bool = True) -> dict[str, Any]:
        return {"iqm": iqm, "finished": finished}

    assert mark_best([cell(2.0), cell(1.0), cell(2.0)]) == [True, False, True]
    assert mark_best([cell(2.0), cell(1.0), cell(2.0, False)]) == [True, False, False]
    assert mark_best([cell(1.0), cell(None), cell(3.0, False)]) == [False] * 3  # one to compare


def test_a_margin_over_next_to_nothing_is_not_told_to_the_per_cent() -> None:
    near_nothing = {"margin": 778.64, "low": 2.0, "high": 900.0}
    assert margin(near_nothing) == "over 10 x"
    assert margin({"margin": 9.5, "low": None, "high": None}) == "+950 %"
    assert margin({"margin": 0.2, "low": 0.05, "high": 0.41}) == "+20 % [+5 %, +41 %]"
