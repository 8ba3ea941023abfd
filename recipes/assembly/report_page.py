"""A study's README.md: what was run, by which commands, and what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from assembly.report_commands import evaluation_command, report_command, training_command
from assembly.report_runs import StudyRun, grouped
from assembly.report_tables import KEPT, format_number

_TRAINING_COLUMNS = (
    ("return", "training return"),
    ("missing ratio", "training missing ratio"),
    ("log-likelihood", "training log-likelihood"),
    ("steps/s", "training steps/s"),
)


def study_page(
    runs: Sequence[StudyRun], summary: Sequence[Mapping[str, Any]], figures: Sequence[str], *,
    title: str, out: Path, options: Sequence[str] = (),
) -> str:  # fmt: skip
    """Write the page.

    Args:
        runs: of the study.
        summary: rows of :func:`assembly.report_tables.summary_rows`.
        figures: names of the PNG files beside the page.
        title: its heading.
        out: folder of the study.
        options: further arguments of the command that made the page.

    Returns:
        Markdown.
    """
    parts = [f"# {title}", _what(runs)]
    parts += [f"![{_FIGURE_TEXTS[name]}]({name})" for name in figures]
    parts += ["## Training", _TRAINING_TEXT, _training_table(runs, summary)]
    evaluated = _evaluation_table(summary)
    if evaluated:
        parts += ["## Evaluation of the last checkpoint", _EVALUATION_TEXT, evaluated]
    parts += ["## Commands", "```bash\n" + "\n".join(_commands(runs, out, options)) + "\n```"]
    parts += ["## Made with", _versions(runs)]
    parts += [
        "Every number behind the tables: `training.csv` (thinned learning curves), "
        "`evaluation.csv` (every evaluation of every run), `summary.csv`."
    ]
    return "\n\n".join(parts) + "\n"


_FIGURE_TEXTS = {
    "learning_curves.png": "Training return over environment steps, one thin line a seed, the "
    "thick line their mean",
    "robustness.png": "Return of the last checkpoint over the realised missing ratio, one thin "
    "line a seed, the thick line their mean",
}
_TRAINING_TEXT = (
    "Mean over seeds, each seed's own number in brackets in the order of the seeds. Return: raw, "
    "sampled actions, mean of the last 100 training episodes. Missing ratio: realised share over "
    "all components, mean over the whole run. Log-likelihood: nats per observed entry, normalised "
    "units, mean of the last tenth of the run. Steps/s: whole training loop, start-up and "
    "evaluation excluded, on whatever else the machine was doing."
)
_EVALUATION_TEXT = (
    "Mean over seeds of the mean raw return, each seed's own in brackets. Normalisation frozen, "
    "noise as in training. Missing ratio and log-likelihood: as above, sampled actions."
)


def _what(runs: Sequence[StudyRun]) -> str:
    """Say in a list what was trained on what."""
    lines = []
    for members in grouped(runs):
        first = members[0].group
        seeds = ", ".join(str(run.settings.seed) for run in members)
        frames = sorted({run.frames for run in members})
        steps = " to ".join(f"{n:,}" for n in dict.fromkeys((frames[0], frames[-1])))
        lines.append(
            f"- {first['task']}, belief `{first['belief']}`, trained on {first['trained_on']} with "
            f"noise sigma {first['noise_sigma']:g}: seeds {seeds}, {steps} environment steps"
        )
        lines += [
            f"  - `{run.name}` is not finished: {run.frames:,} of "
            f"{run.settings.total_frames:,} steps"
            for run in members
            if not run.finished
        ]
    return "\n".join(lines)


def _training_table(runs: Sequence[StudyRun], summary: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for members in grouped(runs):
        group = members[0].group
        found = {row["quantity"]: row for row in summary if _belongs(row, group)}
        cells = [_cell(found[quantity]) for _, quantity in _TRAINING_COLUMNS]
        rows.append(
            [*_group_cells(group), ", ".join(str(r.settings.seed) for r in members), *cells]
        )
    head = ["task", "belief", "trained on", "seeds", *(name for name, _ in _TRAINING_COLUMNS)]
    return _table(head, rows)


def _evaluation_table(summary: Sequence[Mapping[str, Any]]) -> str:
    rows: dict[tuple[Any, ...], dict[tuple[str, str], str]] = {}
    for row in summary:
        if row["quantity"].startswith("evaluation"):
            cells = rows.setdefault((*_group_cells(row), row["point"]), {})
            cells[row["quantity"], row["mode"]] = _cell(row)
    columns = {
        "missing ratio": ("evaluation missing ratio", "sampled"),
        "return, sampled actions": ("evaluation return", "sampled"),
        "of the return with nothing missing": (KEPT, "sampled"),
        "return, mean actions": ("evaluation return", "mean"),
        "log-likelihood": ("evaluation log-likelihood", "sampled"),
    }
    if not rows:
        return ""
    return _table(
        ["task", "belief", "trained on", "evaluated on", *columns],
        [[*key, *(cells.get(c, "") for c in columns.values())] for key, cells in rows.items()],
    )


def _belongs(row: Mapping[str, Any], group: Mapping[str, Any]) -> bool:
    return all(row[key] == value for key, value in group.items())


def _group_cells(group: Mapping[str, Any]) -> list[str]:
    noise = f", sigma {group['noise_sigma']:g}"
    return [group["task"], f"`{group['belief']}`", f"{group['trained_on']}{noise}"]


def _cell(row: Mapping[str, Any]) -> str:
    """Return the mean with every seed's own number beside it."""
    own = [part.split("=", 1)[1] for part in row["per_seed"].split()]
    if all(value == "" for value in own):
        return ""
    shown = ", ".join(_short(float(value)) if value else "none" for value in own)
    mean = "none" if row["mean"] is None else _short(row["mean"])
    return f"**{mean}** ({shown})" if len(own) > 1 else f"**{mean}**"


def _short(value: float) -> str:
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _commands(runs: Sequence[StudyRun], out: Path, options: Sequence[str]) -> list[str]:
    """Return the commands from nothing to this page."""
    evaluations = [evaluation_command(run) for run in runs]
    return [
        *(training_command(run) for run in runs),
        *(command for command in evaluations if command is not None),
        report_command(runs, out, options),
    ]


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
        rows: of a table.

    Returns:
        The rows to write.
    """
    return [{key: format_number(value) for key, value in row.items()} for row in rows]
