"""Report finished runs: ``python recipes/report.py 'run=runs/robust/*' out=results/robust``.

Writes CSV files, figures, and README.md with the tables, the commands and the versions behind them.
No seed is left out. ``notes.md`` in that folder, written by hand, is put below the heading.

``python recipes/report.py out=results/robust`` makes the same again, byte for byte, from the run
folders in ``results/robust/runs`` and the options of the last report, kept in report.yaml.
``python recipes/report.py index=results`` does so for every study there and writes
``results/README.md``.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import hydra
from analysis.report_figures import learning_curves, robustness
from analysis.report_index import index_page, studies_of
from analysis.report_options import OPTIONS_FILE, Options, read_options
from analysis.report_page import Tables, csv_cells, study_page
from analysis.report_paper import aggregate_rows, efficiency_rows, margin_rows
from analysis.report_runs import find_folders, read_study, without_rollout
from analysis.report_tables import evaluation_rows, summary_rows, training_rows
from omegaconf import DictConfig
from rendering.belief_figure import save_figure
from training.console import say, start
from training.errors import UserError
from training.run_folder import write_table, write_whole

NOTES_FILE = "notes.md"
# In this order: the page, which names the others, comes last.
_FILES = (
    OPTIONS_FILE,
    "training.csv",
    "evaluation.csv",
    "summary.csv",
    "aggregate.csv",
    "margins.csv",
    "efficiency.csv",
    "learning_curves.png",
    "robustness.png",
    "robustness_mean_actions.png",
    "README.md",
)


def run(config: dict[str, Any]) -> int:
    """Read the runs and write the study, or every study of an index.

    Args:
        config: see conf/report.yaml.

    Returns:
        The exit status.
    """
    if config["index"] is not None:
        if config["run"] is not None or config["out"] is not None:
            raise UserError("`index` makes every study again: leave out `run` and `out`.")
        return _write_index(Path(config["index"]))
    if config["out"] is None:
        raise UserError(
            "`out` must be given: 'run=runs/*' out=results/<study>, or out=results/<study> alone "
            "to make it again from results/<study>/runs."
        )
    out = Path(config["out"])
    if out.exists() and not out.is_dir():
        raise UserError(f"`out` must be a folder, {out} is a file.")
    wanted = config["run"] if config["run"] is not None else str(out / "runs" / "*")
    _write_study(wanted, out, read_options(config, out))
    return 0


def _write_index(folder: Path) -> int:
    studies = studies_of(folder)
    for study in studies:
        _write_study(str(study / "runs" / "*"), study, read_options({}, study))
    write_whole(folder / "README.md", index_page(folder, studies))
    say(f"{len(studies)} studies, written: {folder / 'README.md'}")
    return 0


def _write_study(wanted: Any, out: Path, options: Options) -> None:
    folders = find_folders(wanted)
    waiting = without_rollout(folders) if options.unfinished else []
    begun = [folder for folder in folders if folder not in waiting]
    if not begun:
        raise UserError(f"`run` must name runs with a finished rollout, {len(waiting)} have none.")
    runs = read_study(begun, unfinished=options.unfinished)
    out.parent.mkdir(parents=True, exist_ok=True)
    # Everything is made beside the study first: an error leaves the old one as it was.
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        summary = summary_rows(runs)
        tables = Tables(
            summary,
            aggregate_rows(summary),
            margin_rows(runs, summary),
            efficiency_rows(runs),
        )
        for name, rows in {
            "training.csv": [row for r in runs for row in training_rows(r, options.rows)],
            "evaluation.csv": [row for r in runs for row in evaluation_rows(r)],
            "summary.csv": tables.summary,
            "aggregate.csv": tables.aggregate,
            "margins.csv": tables.margins,
            "efficiency.csv": tables.efficiency,
        }.items():
            if rows:
                write_table(work / name, csv_cells(rows))
        figures = {
            "learning_curves.png": learning_curves(runs, options.rows),
            "robustness.png": robustness(runs, "sampled"),
            "robustness_mean_actions.png": robustness(runs, "mean"),
        }
        drawn = {name: figure for name, figure in figures.items() if figure is not None}
        for name, figure in drawn.items():
            save_figure(figure, work / name, dpi=110)
        name = out.resolve().name
        page = study_page(
            runs,
            tables,
            list(drawn),
            title=options.title or name,
            notes=_notes(out),
            name=name,
            options=options.words(),
            waiting=[folder.name for folder in waiting],
        )
        write_whole(work / "README.md", page)
        write_whole(work / OPTIONS_FILE, options.text())
        out.mkdir(exist_ok=True)
        for name in _FILES:
            if (work / name).is_file():
                os.replace(work / name, out / name)
            else:
                (out / name).unlink(missing_ok=True)  # of an earlier report, no longer true
    finally:
        shutil.rmtree(work, ignore_errors=True)
    say(f"{len(runs)} runs, written: {out}")


def _notes(out: Path) -> str:
    path = out / NOTES_FILE
    return path.read_text(encoding="utf-8") if path.is_file() else ""


@hydra.main(version_base="1.3", config_path="../conf", config_name="report")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
