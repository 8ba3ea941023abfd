"""Report finished runs: ``python recipes/report.py 'run=runs/*' out=results/<study>``.

Writes training.csv, evaluation.csv, summary.csv, figures, and README.md with the tables, the
commands and the versions behind them. No seed is left out. The same run folders give the same
bytes in every table and page.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

import hydra
from assembly.belief_figure import save_figure
from assembly.console import run_or_explain, say
from assembly.errors import UserError
from assembly.report_figures import learning_curves, robustness
from assembly.report_page import csv_cells, study_page
from assembly.report_runs import find_folders, read_study
from assembly.report_tables import evaluation_rows, summary_rows, training_rows
from assembly.run_folder import write_table, write_whole
from omegaconf import DictConfig, OmegaConf

# In this order: the page, which names the others, comes last.
_FILES = (
    "training.csv",
    "evaluation.csv",
    "summary.csv",
    "learning_curves.png",
    "robustness.png",
    "README.md",
)


def run(config: dict[str, Any]) -> int:
    """Read the runs and write the study.

    Args:
        config: see conf/report.yaml.

    Returns:
        The exit status.
    """
    if config["run"] is None or config["out"] is None:
        raise UserError("`run` and `out` must be given: 'run=runs/*' out=results/<study>.")
    if config["rows"] < 2:
        raise UserError(f"`rows` must be 2 or more, got {config['rows']}.")
    out = Path(config["out"])
    if out.exists() and not out.is_dir():
        raise UserError(f"`out` must be a folder, {out} is a file.")
    runs = read_study(find_folders(config["run"]), unfinished=config["unfinished"])
    out.parent.mkdir(parents=True, exist_ok=True)
    # Everything is made beside the study first: an error leaves the old one as it was.
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        summary = summary_rows(runs)
        write_table(
            work / "training.csv",
            csv_cells([row for r in runs for row in training_rows(r, config["rows"])]),
        )
        evaluations = csv_cells([row for r in runs for row in evaluation_rows(r)])
        if evaluations:
            write_table(work / "evaluation.csv", evaluations)
        write_table(work / "summary.csv", csv_cells(summary))
        figures = {
            "learning_curves.png": learning_curves(runs, config["rows"]),
            "robustness.png": robustness(runs),
        }
        drawn = {name: figure for name, figure in figures.items() if figure is not None}
        for name, figure in drawn.items():
            save_figure(figure, work / name, dpi=110)
        title = config["title"] or out.resolve().name
        page = study_page(
            runs, summary, list(drawn), title=title, out=out.resolve(), options=_options(config)
        )
        write_whole(work / "README.md", page)
        out.mkdir(exist_ok=True)
        for name in _FILES:
            if (work / name).is_file():
                os.replace(work / name, out / name)
            else:
                (out / name).unlink(missing_ok=True)  # of an earlier report, no longer true
    finally:
        shutil.rmtree(work, ignore_errors=True)
    say(f"{len(runs)} runs, written: {out}")
    return 0


def _options(config: dict[str, Any]) -> list[str]:
    """Return what else the study depends on, as arguments; a title in Hydra's quotes."""
    options = [f"rows={config['rows']}"]
    if config["title"] is not None:
        quoted = str(config["title"]).replace("\\", "\\\\").replace('"', '\\"')
        options.append(f'title="{quoted}"')
    if config["unfinished"]:
        options.append("unfinished=true")
    return options


@hydra.main(version_base="1.3", config_path="../conf", config_name="report")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    status = run_or_explain(lambda: run(plain))
    if status:
        sys.exit(status)


if __name__ == "__main__":
    main()
