"""A study's README.md: what was run, by which commands, and what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.report_cells import margin, markdown_table, number, percent, two_steps, with_interval
from analysis.report_commands import commands_from_nothing, rebuild_command
from analysis.report_evaluations import Row
from analysis.report_paper import THRESHOLDS, task_family
from analysis.report_runs import StudyRun, grouped, trained_on
from analysis.report_statistics import interquartile_mean
from analysis.report_tables import DIVERGED, KEPT, format_number
from analysis.report_variants import mark_best, variant_lines, variant_order

_TRAINING_COLUMNS = (
    ("return", "training return"),
    ("missing ratio", "training missing ratio"),
    ("log-likelihood", "training log-likelihood"),
    ("steps/s", "training steps/s"),
)
_MODES = {"sampled": "sampled actions", "mean": "mean actions"}


@dataclass(frozen=True)
class Tables:
    """What a page shows; each is a CSV file of the study too.

    Attributes:
        summary: rows of :func:`analysis.report_tables.summary_rows`.
        aggregate: rows of :func:`analysis.report_paper.aggregate_rows`.
        margins: rows of :func:`analysis.report_paper.margin_rows`.
        efficiency: rows of :func:`analysis.report_paper.efficiency_rows`.
    """

    summary: Sequence[Row]
    aggregate: Sequence[Row]
    margins: Sequence[Row]
    efficiency: Sequence[Row]


def study_page(
    runs: Sequence[StudyRun], tables: Tables, figures: Sequence[str], *, title: str, notes: str,
    name: str, options: Sequence[str] = (), waiting: Sequence[str] = (),
) -> str:  # fmt: skip
    """Write the page.

    Args:
        runs: of the study.
        tables: what came out.
        figures: names of the PNG files beside the page.
        title: its heading.
        notes: what a person says about it, Markdown; put below the heading as it is.
        name: of the folder of the study.
        options: further arguments of the command that made the page.
        waiting: names of runs that have finished no rollout yet.

    Returns:
        Markdown.
    """
    parts = [f"# {title}", notes.strip(), _unfinished(runs, waiting)]
    parts += [f"![{FIGURE_TEXTS[figure]}]({figure})" for figure in figures]
    parts += ["## Training", _TRAINING_TEXT, _training_table(runs, tables.summary)]
    parts += _variant_table(runs, tables.summary)
    evaluated = _evaluation_tables(tables.summary)
    if evaluated:
        parts += ["## Evaluation of the last checkpoint", _EVALUATION_TEXT, *evaluated]
    if tables.aggregate:
        parts += ["## Over all tasks", _AGGREGATE_TEXT, _aggregate_table(tables.aggregate)]
    if tables.margins:
        parts += ["## Margins of drbpn", _MARGIN_TEXT, _margin_table(tables.margins)]
    if tables.efficiency:
        parts += ["## Sample efficiency", _EFFICIENCY_TEXT, _efficiency_table(tables.efficiency)]
    commands = "\n".join(commands_from_nothing(runs, name, options))
    parts += ["## Commands", f"From nothing to this page:\n\n```bash\n{commands}\n```"]
    parts += [
        "Tables and page again, byte for byte, from the run folders that lie beside it:\n\n"
        f"```bash\n{rebuild_command(name)}\n```"
    ]
    parts += ["## Made with", _versions(runs)]
    parts += ["Every number behind the tables stands in the CSV files beside this page."]
    return "\n\n".join(part for part in parts if part) + "\n"


FIGURE_TEXTS = {
    "learning_curves.png": "Training return over environment steps: interquartile mean over seeds "
    "and its 95 % interval",
    "robustness.png": "Return of the last checkpoint over the realised missing ratio, sampled "
    "actions: interquartile mean over seeds and its 95 % interval; in grey the nominal ratio",
    "robustness_mean_actions.png": "The same with mean actions",
}
_TRAINING_TEXT = (
    "Return: raw, sampled actions, mean of the last 100 training episodes; **interquartile mean** "
    "over seeds [95 % interval] (each seed's own). Of fewer than four seeds the interquartile mean "
    "is the mean, and the bootstrap interval is their range: it says how far they lie apart, and "
    "holds the true mean of normal data in half of all cases with two seeds, in three quarters "
    "with three. The other columns are means over seeds. Missing "
    "ratio: realised share over all components, mean over the whole run. Log-likelihood: nats per "
    "observed entry, normalised units, mean of the last tenth of the run. Steps/s: whole training "
    "loop, start-up and evaluation excluded, on whatever else the machine was doing."
)
_VARIANT_TEXT = (
    "Return in training: raw, sampled actions, mean of the last 100 episodes; interquartile mean "
    "over seeds [95 % interval]. **Bold**: the best of its line, among the runs that have come to "
    "their end. A cell that was not run is empty."
)
_EVALUATION_TEXT = (
    "Mean raw return of the episodes of a seed; **interquartile mean** over seeds [95 % bootstrap "
    "interval], then the mean over seeds of each agent's share of its own return with nothing "
    "missing, where that was evaluated and is positive, and the share of episodes in which the "
    "belief diverged, where there are any: such a robot gets zero actions to its end. Empty: not "
    "evaluated. Normalisation frozen, noise as in training. Missing ratio: "
    "realised share over all components, mean over the methods of the row. A point that was "
    "evaluated both by itself (points.csv) and on the grid (robustness.csv) counts as on the grid; "
    "evaluation.csv names the table and the seed of the episodes."
)
_AGGREGATE_TEXT = (
    "Returns as shares of the paper's thresholds (below 1: under the threshold), **interquartile "
    "mean** over all runs of all tasks [95 % interval, runs resampled within their task]."
)
_MARGIN_TEXT = (
    "Where half of all entries may be missing: interquartile mean of drbpn's return over that of "
    "the other method, less one [95 % bootstrap interval, both resampled]. Beside it what the "
    "paper gives: its margins over DVRL at ratio .5. Steps: of drbpn, and of the other method. "
    "Where they differ, the last checkpoints are compared as they are, which says nothing about "
    "the methods alone; the row `training` compares training returns at the same number of steps."
)
_EFFICIENCY_TEXT = (
    "Complete, exact observations, within 2M environment steps. Top-10: the mean of the ten best "
    "training episodes of a run, raw return, sampled actions; **interquartile mean** over seeds "
    "(each seed's own). Steps to the threshold of the paper: when the mean of the last 100 "
    "training episodes first reached it, each seed's own, to one rollout."
)


def _unfinished(runs: Sequence[StudyRun], waiting: Sequence[str]) -> str:
    """Say in a list which runs have not come to their end."""
    lines = [
        f"- `{run.name}` is not finished: {run.frames:,} of {run.settings.total_frames:,} steps"
        for run in runs
        if not run.finished
    ]
    lines += [f"- `{name}` has finished no rollout yet" for name in waiting]
    return "\n".join(lines)


# Tables ---------------------------------------------------------------------------------------


def _training_table(runs: Sequence[StudyRun], summary: Sequence[Row]) -> str:
    rows = []
    for members in grouped(runs):
        group = members[0].group
        found = {row["quantity"]: row for row in summary if _belongs(row, group)}
        first, *others = (found[quantity] for _, quantity in _TRAINING_COLUMNS)
        frames = sorted({run.frames for run in members})
        steps = " to ".join(f"{n:,}" for n in dict.fromkeys((frames[0], frames[-1])))
        cells = [_with_seeds(first), *(number(row["mean"]) for row in others)]
        seeds = ", ".join(str(run.settings.seed) for run in members)
        rows.append(
            [group["task"], f"`{group['method']}`", trained_on(group), seeds, steps, *cells]
        )
    head = ["task", "method", "trained on", "seeds", "steps", *(n for n, _ in _TRAINING_COLUMNS)]
    return markdown_table(head, rows)


def _variant_table(runs: Sequence[StudyRun], summary: Sequence[Row]) -> list[str]:
    """Return a heading and a table over the axes beside task, method and seed, where there are."""
    returns = [row for row in summary if row["quantity"] == "training return"]
    variants = sorted({row["variant"] for row in returns}, key=variant_order)
    if len(variants) < 2:
        return []
    groups = []
    for members in grouped(runs):
        (found,) = (row for row in returns if _belongs(row, members[0].group))
        finished = all(run.finished for run in members)
        groups.append(found | {"members": members, "finished": finished})
    lines = variant_lines(groups)
    rows = []
    for key, by_variant in lines.items():
        task, method, *corruption = key
        cells = [by_variant[v] for v in variants if v in by_variant]
        best = dict(zip((cell["variant"] for cell in cells), mark_best(cells), strict=True))
        steps = max(run.frames for cell in cells for run in cell["members"])
        seeds = sorted({run.settings.seed for cell in cells for run in cell["members"]})
        texts = [_variant_cell(by_variant[v], best[v]) if v in by_variant else "" for v in variants]
        head = [task, f"`{method}`", *corruption, ", ".join(map(str, seeds)), f"{steps:,}"]
        rows.append([*head, *texts])
    axes = " and ".join(dict.fromkeys(axis for run in runs for axis in run.axes))
    corrupted = ["trained on"] * (max(map(len, lines)) - 2)
    names = [f"`{variant}`" if variant else "none" for variant in variants]
    head = ["task", "method", *corrupted, "seeds", "steps", *names]
    return [f"## By {axes}", _VARIANT_TEXT, markdown_table(head, rows)]


def _variant_cell(row: Row, best: bool) -> str:
    text = number(row["iqm"]) or "none"
    if row["low"] is not None:
        text = f"{text} [{number(row['low'])}, {number(row['high'])}]"
    if not row["finished"]:
        return f"{text} at {min(run.frames for run in row['members']):,} steps"
    return f"**{text}**" if best else text


def _evaluation_tables(summary: Sequence[Row]) -> list[str]:
    """Return a heading and a table for each task, training corruption and kind of action."""
    tables: dict[tuple[str, str, str], dict[str, dict[str, dict[str, Row]]]] = {}
    for row in summary:
        if row["quantity"].startswith("evaluation"):
            table = tables.setdefault((row["task"], trained_on(row), row["mode"]), {})
            line = table.setdefault(row["point"], {})
            line.setdefault(row["method"], {})[row["quantity"]] = row
    parts = []
    for (task, trained, mode), table in tables.items():
        methods = list(dict.fromkeys(method for line in table.values() for method in line))
        rows = []
        for point, line in table.items():
            ratios = [line[m]["evaluation missing ratio"]["mean"] for m in methods if m in line]
            known = [ratio for ratio in ratios if ratio is not None]
            ratio = number(sum(known) / len(known)) if known else ""
            rows.append([point, ratio, *(_evaluated(line.get(method, {})) for method in methods)])
        parts.append(f"### {task}, trained on {trained}, {_MODES[mode]}")
        head = ["evaluated on", "missing ratio", *(f"`{method}`" for method in methods)]
        parts.append(markdown_table(head, rows))
    return parts


def _evaluated(quantities: Mapping[str, Row]) -> str:
    if "evaluation return" not in quantities:
        return ""
    text = with_interval(quantities["evaluation return"])
    if (kept := quantities.get(KEPT)) is not None:
        text += f" {100 * kept['iqm']:.0f} %"
    if (diverged := quantities.get(DIVERGED)) is not None:
        text += f" (diverged: {100 * diverged['mean']:.0f} %)"
    return text


def _aggregate_table(aggregate: Sequence[Row]) -> str:
    methods = list(dict.fromkeys(row["method"] for row in aggregate))
    lines: dict[tuple[str, str, str], dict[str, str]] = {}
    for row in aggregate:
        key = (row["trained_on"], row["point"], _MODES[row["mode"]])
        lines.setdefault(key, {})[row["method"]] = with_interval(row)
    head = ["trained on", "evaluated on", "actions", *(f"`{method}`" for method in methods)]
    return markdown_table(
        head, [[*key, *(c.get(m, "") for m in methods)] for key, c in lines.items()]
    )


def _margin_table(margins: Sequence[Row]) -> str:
    head = ["task", "trained on", "evaluated on", "actions", "over", "steps", "margin", "paper"]
    rows = [
        [
            row["task"],
            row["trained_on"],
            row["point"],
            _MODES[row["mode"]],
            f"`{row['over']}`",
            two_steps(row),
            margin(row),
            "" if row["paper"] is None else percent(row["paper"]),
        ]
        for row in margins
    ]
    return markdown_table(head, rows)


def _efficiency_table(efficiency: Sequence[Row]) -> str:
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in efficiency:
        method = f"`{row['method']}`" + (f", {row['variant']}" if row["variant"] else "")
        groups.setdefault((row["task"], method), []).append(row)
    rows = []
    for (task, method), members in groups.items():
        threshold = THRESHOLDS.get(task_family(task))
        steps = [
            f"{row['steps_to_threshold']:,}"
            if row["steps_to_threshold"] is not None
            else f"not reached in {row['frames']:,}"
            for row in members
        ]
        rows.append(
            [
                task,
                method,
                ", ".join(str(row["seed"]) for row in members),
                _top(members),
                "" if threshold is None else f"{threshold:g}",
                "" if threshold is None else ", ".join(steps),
            ]
        )
    head = ["task", "method", "seeds", "top-10 return", "threshold", "steps to the threshold"]
    return markdown_table(head, rows)


# Cells ----------------------------------------------------------------------------------------


def _top(members: Sequence[Row]) -> str:
    values = [row["top_10_return"] for row in members]
    own = ", ".join(number(value) or "no episodes.csv" for value in values)
    if None in values:
        return own
    return f"**{number(float(interquartile_mean(np.array(values))))}** ({own})"


def _with_seeds(row: Row) -> str:
    """Return an interquartile mean with its interval and every seed's own number."""
    own = [part.split("=", 1)[1] for part in row["per_seed"].split()]
    if all(value == "" for value in own):
        return ""
    shown = ", ".join(number(float(value)) if value else "none" for value in own)
    return f"{with_interval(row)} ({shown})" if len(own) > 1 else with_interval(row)


def _belongs(row: Row, group: Row) -> bool:
    return all(row[key] == value for key, value in group.items())


def _versions(runs: Sequence[StudyRun]) -> str:
    """List versions and commits; where runs differ, which run had which."""
    names = [name for name in runs[0].versions if name != "platform"]
    names += [n for run in runs for n in run.versions if n not in names and n != "platform"]
    lines = []
    for name in dict.fromkeys(names):
        by_value: dict[str, list[str]] = {}
        for run in runs:
            by_value.setdefault(run.versions.get(name, "unknown"), []).append(run.name)
        if len(by_value) == 1:
            lines.append(f"- {name.replace('_', ' ')}: {next(iter(by_value))}")
        else:
            told = "; ".join(f"{value} ({', '.join(who)})" for value, who in by_value.items())
            lines.append(f"- {name.replace('_', ' ')}: {told}")
    return "\n".join(lines)


def csv_cells(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return rows with every cell as text, numbers in one fixed form.

    Args:
        rows: of a table; ``values`` is left out, its numbers stand in other columns, and
            ``variant`` where no row has one.

    Returns:
        The rows to write.
    """
    left_out = {"values"} if any(row.get("variant") for row in rows) else {"values", "variant"}
    return [
        {key: format_number(value) for key, value in row.items() if key not in left_out}
        for row in rows
    ]
