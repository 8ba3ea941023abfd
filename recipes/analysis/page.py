"""The page of a study: its tables in Markdown, and how to read them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from analysis.runs import GROUP, THRESHOLDS, Study
from analysis.statistics import interquartile_mean
from analysis.tables import TRAINING, family

_READING = """Returns are raw. **Interquartile mean** over seeds [95 % bootstrap interval over
seeds]; of one to three seeds the interquartile mean is the plain mean, and the interval is that
of the mean of these seeds, with two or three of them their range: it says how far they lie
apart, and holds the true mean of normal data in half of all cases with two seeds, in three
quarters with three. In per cent: the share of its own return with nothing missing (defined in
results/README.md)."""
_FIGURES = {
    "learning_curves.png": "Training return over environment steps: interquartile mean over seeds "
    "and its 95 % interval",
    "robustness.png": "Return of the last checkpoint under each condition, sampled actions: "
    "interquartile mean over seeds and its 95 % interval; in grey the nominal ratio",
    "robustness_mean_actions.png": "The same with mean actions",
}
_TRAINING = """Return: sampled actions, the last 100 training episodes. Missing ratio: realised
share over all components. Log-likelihood: nats per observed entry, normalised units, the last
tenth of the run. Steps/s: whole training loop beside whatever else the machine was doing."""
_EVALUATION = """Last checkpoint, normalisation frozen, noise as in training where the condition
names none. In brackets behind a return: the share of episodes in which the belief diverged, if
any; such a robot gets zero actions to its end. Empty: not evaluated with every seed."""
_AGGREGATE = """Returns as shares of the paper's thresholds, over all runs of all tasks; runs
are resampled within their task."""
_COMPARISON = """Where half of all entries may be missing: the interquartile mean of the one
over that of the other, less one, and the probability that a run of the one beats a run of the
other (ties are halves), mean over tasks; both [95 % bootstrap interval]. Beside it the paper's
margin over DVRL at ratio .5. Where the two were trained for unequal numbers of steps, the row
`training` compares their training returns at equal steps."""
_EFFICIENCY = """Complete, exact observations, within 2M steps. Top-10: mean of the ten best
training episodes of a run. Steps to the threshold: when the mean of the last 100 training
episodes first reached it, for each seed."""


def page(
    study: Study,
    tables: Mapping[str, pd.DataFrame],
    figures: Sequence[str],
    *,
    title: str,
    notes: str,
    folder: str,
) -> str:
    """Return the page in Markdown; ``figures`` are names of PNG files beside it."""
    summary, runs = tables["summary"], study.runs
    parts = [f"# {title}", notes.strip()]
    parts += [
        f"- `{r.run}` is not finished: {r.frames:,} steps"
        for r in runs[~runs.finished].itertuples()
    ]
    parts += [_READING, *(f"![{_FIGURES[name]}]({name})" for name in figures)]
    parts += ["## Training", _TRAINING, _training(summary, runs)]
    if runs.overrides.any():
        settings = runs.groupby("method").overrides.unique().map("; ".join)
        parts += ["Settings in which the runs differ:", _markdown(settings.reset_index())]
    tested = summary[summary.point != TRAINING]
    for mode, rows in tested.groupby("mode", sort=False):
        parts += [f"## Evaluation, {mode} actions", _EVALUATION, _evaluation(rows)]
    if len(tables["aggregate"]):
        score = _spread(tables["aggregate"].assign(text=lambda t: t.apply(_interval, axis=1)))
        parts += ["## Over all tasks", _AGGREGATE, score]
    if len(tables["comparison"]):
        sampled = tables["comparison"].query("mode == 'sampled'")
        parts += ["## Comparison", _COMPARISON, _comparison(sampled)]
    clean = runs[(runs.trained_on == "none:0") & (runs.noise_sigma == 0)]
    if len(clean):
        parts += ["## Sample efficiency", _EFFICIENCY, _efficiency(clean)]
    command = f"python recipes/report.py from=results/{folder}"
    tables_here = "from runs.csv, training.csv and evaluation.csv beside this page."
    parts += ["## Made with", _versions(runs)]
    parts += [f"Page, further tables and figures: `{command}`, {tables_here}"]
    return "\n\n".join(part for part in parts if part) + "\n"


def number(value: Any) -> str:
    """Return a number with about three digits; nothing for NaN."""
    if pd.isna(value):
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _interval(row: Any, name: str = "score", low: str = "low", high: str = "high") -> str:
    ends = "" if pd.isna(row[low]) else f" [{number(row[low])}, {number(row[high])}]"
    return f"**{number(row[name])}**{ends}"


def _markdown(table: pd.DataFrame) -> str:
    """Return a table; columns in which every row is empty or zero noise are left out."""
    table = table.rename(columns=lambda name: str(name).replace("_", " ")).fillna("")
    return table.loc[:, (table != "").any()].to_markdown(index=False, disable_numparse=True)


def _conditions(table: pd.DataFrame) -> pd.DataFrame:
    """Join what a run was trained on and its settings into one column."""
    sigma = table.noise_sigma.map("{:g}".format)
    settings = table.settings.where(table.settings == "", ", " + table.settings)
    return table.assign(trained_on=table.trained_on + ", sigma " + sigma + settings)


def _spread(table: pd.DataFrame, point: str = "evaluated on") -> str:
    """Return a table with a column for each method and a row for each condition."""
    table = _conditions(table)
    rows = [name for name in ("task", "trained_on", "point", "mode") if name in table]
    order = table[rows].drop_duplicates()
    wide = table.pivot_table("text", rows, "method", aggfunc="first").reset_index()
    return _markdown(order.merge(wide, on=rows).rename(columns={"point": point}))


def _training(summary: pd.DataFrame, runs: pd.DataFrame) -> str:
    frames = runs.groupby(GROUP, as_index=False).agg(steps=("frames", "min"))
    table = _conditions(summary[summary.point == TRAINING].merge(frames, on=GROUP))
    shown = table[["task", "method", "trained_on", "seeds"]].assign(
        steps=table.steps.map("{:,}".format),
        **{"return": table.apply(_interval, name="return", axis=1)},
        of_each_seed=[
            ", ".join(number(float(part.split("=")[1])) for part in own.split())
            for own in table.per_seed
        ],
        missing_ratio=table.missing_ratio.map(number),
        log_likelihood=table.log_likelihood.map(number),
    )
    return _markdown(shown.assign(**{"steps/s": table.steps_per_second.map(number)}))


def _evaluation(rows: pd.DataFrame) -> str:
    text = rows.apply(_interval, name="return", axis=1)
    text += [f" {share:.0%}" if share == share else "" for share in rows.share]
    text += [f" (diverged: {share:.0%})" if share > 0 else "" for share in rows.diverged]
    ratio = rows.groupby(["task", "point"]).missing_ratio.transform("mean").map("{:.2f}".format)
    rows = rows.drop(columns="mode").assign(text=text, point=rows.point + ", " + ratio)
    return _spread(rows, "evaluated on, missing ratio")


def _comparison(table: pd.DataFrame) -> str:
    table = _conditions(table.assign(**{n: table.get(n, np.nan) for n in ("margin", "paper")}))
    names = {"name": "probability", "low": "probability_low", "high": "probability_high"}
    shown = [
        {
            "steps": "" if r.steps != r.steps else f"{r.steps:,.0f}"
            + (f" and {r.steps_over:,.0f}" if r.steps != r.steps_over else ""),
            "margin": _percent(r.margin)
            + (f" [{_percent(r.low)}, {_percent(r.high)}]" if r.low == r.low else ""),
            "probability": _interval(r, **names),
            "paper": _percent(r.paper),
        }
        for _, r in table.iterrows()
    ]  # fmt: skip
    first = table[["task", "trained_on", "point", "method", "over"]].reset_index(drop=True)
    first = first.rename(columns={"point": "evaluated on"})
    return _markdown(pd.concat([first, pd.DataFrame(shown)], axis=1))


def _percent(value: float) -> str:
    return "" if pd.isna(value) else f"{value:+.0%}"


def _efficiency(runs: pd.DataFrame) -> str:
    rows = []
    names = ["task", "method", "settings"]
    for key, members in runs.groupby(names):
        top = members.top_10_return.to_numpy(float)
        steps = [number(s) or "not reached" for s in members.steps_to_threshold]
        row = {
            "top-10 return": number(interquartile_mean(top)),
            "of each seed": ", ".join(map(number, top)),
            "threshold": number(family(members.task).map(THRESHOLDS).iloc[0]),
            "steps to it": ", ".join(steps),
        }
        rows.append(dict(zip(names, key, strict=True)) | row)
    return _markdown(pd.DataFrame(rows))


def _versions(runs: pd.DataFrame) -> str:
    return "\n".join(
        f"- {name.replace('git_', '')}: {', '.join(runs[name].dropna().astype(str).unique())}"
        for name in ("git_commit", "torch", "torchrl", "gymnasium", "mujoco")
        if name in runs
    )
