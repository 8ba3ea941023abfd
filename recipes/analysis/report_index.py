"""results/README.md: every study in a few lines and its tables, from the CSV files of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from training.errors import UserError

from analysis.report_cells import (
    margin,
    markdown_table,
    number,
    percent,
    two_steps,
    with_interval,
)
from analysis.report_evaluations import Row, read_csv
from analysis.report_page import FIGURE_TEXTS
from analysis.report_paper import THRESHOLDS, task_family
from analysis.report_runs import trained_on

_HEAD = """# Results

One folder a study, each made by one command from the run folders beside it; its notes say what is
missing or was added. Its `README.md` holds the tables, the commands from nothing to the page, and
the versions; the CSV files beside it hold every seed's own numbers and what the figures were drawn
from.

This page, and every table below it, byte for byte from the run folders in `<study>/runs`:

```bash
python recipes/report.py index=results
```

Returns are raw, of sampled actions: **interquartile mean** over seeds [95 % bootstrap interval].
Training: the last 100 episodes; the other columns: the last checkpoint, evaluated with nothing
missing (none:0) and with half of all entries missing or open to be (.5). The paper: its threshold
of the return on complete, exact observations, and its margin over DVRL at ratio .5; its Table 1 has
more, which its public text does not show.

The run folders hold their last checkpoints, so that an agent can be looked at without training it:

```bash
python recipes/plot_belief.py run=results/<study>/runs/<run> point=mcar:0.7
```
"""


def studies_of(folder: Path) -> list[Path]:
    """Return the studies of a folder that hold their runs.

    Args:
        folder: such as results/.

    Returns:
        Their folders, sorted.

    Raises:
        UserError: if there is none.
    """
    if not folder.is_dir():
        raise UserError(f"`index` must be a folder of studies, there is no folder {folder}.")
    found = sorted(path.parent for path in folder.glob("*/runs") if path.is_dir())
    if not found:
        raise UserError(
            f"`index` must be a folder of studies that hold their run folders in <study>/runs; "
            f"{folder} holds none."
        )
    return found


def index_page(folder: Path, studies: Sequence[Path]) -> str:
    """Write the page over all studies.

    Args:
        folder: in which it lies.
        studies: folders of it with a report.

    Returns:
        Markdown: for each study its heading, the first paragraph of its notes.md, and its tables:
        returns by task and method, the margins that the paper gives one of too, and how soon the
        paper's thresholds were passed; its figures, and links to what lies beside them.
    """
    parts = [_HEAD.strip()]
    for study in studies:
        lines = (study / "README.md").read_text(encoding="utf-8").splitlines()
        parts.append(f"## [{lines[0].removeprefix('# ')}]({study.relative_to(folder)}/README.md)")
        notes = study / "notes.md"
        if notes.is_file():
            parts.append(notes.read_text(encoding="utf-8").strip().split("\n\n")[0])
        place = study.relative_to(folder)
        parts += [
            f"![{FIGURE_TEXTS[name]}]({place}/{name})"
            for name in _FIGURES
            if (study / name).is_file()
        ]
        parts += [_returns(study), _margins(study), _efficiency(study)]
        more = [f"[{name}]({place}/{name}/)" for name in _FOLDERS if (study / name).is_dir()]
        parts.append(f"Beside it: {', '.join(more)}." if more else "")
    return "\n\n".join(part for part in parts if part) + "\n"


_FIGURES = ("learning_curves.png", "robustness.png")
_FOLDERS = ("diagnosis", "sensors", "ablations")  # what other commands have left there
_SHOWN = ("none:0", "mcar:0.5", "mar:0.5")  # points
_TRAINING = "training return"


def _returns(study: Path) -> str:
    """Return the table of the returns of a study."""
    groups: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in read_csv(study / "summary.csv", {"task", "method", "quantity", "point", "iqm"}):
        evaluated = row["quantity"] == "evaluation return" and row["mode"] == "sampled"
        if row["quantity"] == _TRAINING or (evaluated and row["point"] in _SHOWN):
            row["variant"] = row.get("variant") or ""
            group = (row["task"], row["method"], trained_on(row))
            point = _TRAINING if row["quantity"] == _TRAINING else row["point"]
            groups.setdefault(group, {})[point] = row
    points = [p for p in _SHOWN if any(p in found for found in groups.values())]
    complete = {
        group
        for group, found in groups.items()
        if found[_TRAINING]["trained_on"] == "none:0" and found[_TRAINING]["noise_sigma"] == 0
    }
    rows = []
    for group, found in groups.items():
        task, method, corruption = group
        cells = [with_interval(found[p]) if p in found else "" for p in (_TRAINING, *points)]
        line = [task, f"`{method}`", corruption, f"{found[_TRAINING]['seeds']:g}", *cells]
        if complete:
            threshold = THRESHOLDS.get(task_family(task)) if group in complete else None
            line.append("" if threshold is None else f"{threshold:g}")
        rows.append(line)
    head = ["task", "method", "trained on", "seeds", "training", *points]
    return markdown_table([*head, "paper"] if complete else head, rows)


def _margins(study: Path) -> str:
    """Return the table of the margins that the paper gives one of too; nothing without any."""
    path = study / "margins.csv"
    needed = {"task", "over", "margin", "paper", "steps", "steps_over"}
    rows = [
        [
            row["task"],
            row["trained_on"],
            row["point"],
            f"`{row['over']}`",
            two_steps(row),
            margin(row),
            percent(row["paper"]),
        ]
        for row in (read_csv(path, needed) if path.is_file() else [])
        if row["paper"] is not None and row["mode"] == "sampled"
    ]
    head = ["task", "trained on", "evaluated on", "over", "steps", "margin of `drbpn`", "paper"]
    return markdown_table(head, rows) if rows else ""


def _efficiency(study: Path) -> str:
    """Return the steps to the paper's thresholds; nothing where data was incomplete."""
    path = study / "efficiency.csv"
    needed = {"task", "method", "seed", "top_10_return", "threshold", "steps_to_threshold"}
    groups: dict[tuple[str, str, float | None], list[Row]] = {}
    for row in read_csv(path, needed) if path.is_file() else []:
        method = f"`{row['method']}`" + (f", {row['variant']}" if row.get("variant") else "")
        groups.setdefault((row["task"], method, row["threshold"]), []).append(row)
    rows = [
        [
            task,
            method,
            "; ".join(number(row["top_10_return"]) or "unknown" for row in members),
            f"{threshold:g}",
            "; ".join(_steps(row["steps_to_threshold"]) for row in members),
        ]
        for (task, method, threshold), members in groups.items()
        if threshold is not None
    ]
    head = ["task", "method", "top-10 return of each seed", "paper's threshold", "steps to it"]
    return markdown_table(head, rows) if rows else ""


def _steps(steps: float | None) -> str:
    return "not reached" if steps is None else f"{steps:,.0f}"
