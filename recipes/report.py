"""Report finished runs: ``python recipes/report.py 'run=runs/robust/*' out=results/robust``.

Writes what was measured (runs.csv, training.csv, evaluation.csv), and from these alone further
tables, figures and README.md; ``from=results/robust`` makes the latter again, ``'from=results/*'``
of every study. notes.md in that folder, written by hand, is put below the heading.
"""

import glob
from math import inf
from pathlib import Path
from typing import Any

from analysis.figures import learning_curves, robustness
from analysis.page import page
from analysis.runs import Study, read_runs
from analysis.tables import derived_tables
from evaluation.folders import find_folders
from rendering.style import write_or_remove
from training.config import check_limits, command
from training.console import log_line
from training.errors import UserError
from training.run_folder import write_whole

NOTES_FILE = "notes.md"


def run(config: dict[str, Any]) -> int:
    """Write a study from its runs, or pages from tables alone; see conf/report.yaml."""
    if config["from"] is not None:
        if config["run"] is not None or config["out"] is not None:
            raise UserError(
                "`from` reads and writes the tables of a study: leave out `run`, `out`."
            )
        for folder in _studies(config["from"]):
            _write_page(folder, config)
        return 0
    out = config["out"] and Path(config["out"])
    if not out or out.is_file():
        raise UserError(f"`out` must be the folder of a study, such as results/robust, got {out}.")
    check_limits(config, {"rows": (2, inf)}, whole=True)
    how = {name: config[name] for name in ("rows", "unfinished")}
    study = read_runs(find_folders(config["run"]), config["table"], **how)
    out.mkdir(parents=True, exist_ok=True)
    study.write(out)
    _write_page(out, config)
    return 0


def _studies(wanted: str | list[str]) -> list[Path]:
    texts = [wanted] if isinstance(wanted, str) else wanted
    found = sorted({Path(p) for text in texts for p in glob.glob(str(text))})
    studies = [folder for folder in found if (folder / "runs.csv").is_file()]
    if not studies:
        raise UserError(f"`from` must name folders with a runs.csv, {wanted} matches none.")
    return studies


def _write_page(folder: Path, config: dict[str, Any]) -> None:
    """Write all that follows from the tables of a study."""
    study = Study.read(folder)
    tables = derived_tables(study, config["reference"])
    figures: dict[str, Any] = {"learning_curves.png": learning_curves(study.training)}
    for mode, name in (("sampled", "robustness.png"), ("mean", "robustness_mean_actions.png")):
        shown = tables["summary"][tables["summary"]["mode"] == mode]
        figures[name] = robustness(shown, rows="kind", columns="task")
    for name, table in tables.items():
        write_or_remove(folder / f"{name}.csv", table if len(table) else None)
    for name, figure in figures.items():
        write_or_remove(folder / name, figure, dpi=80, palette=True)
    drawn = [name for name, figure in figures.items() if figure is not None]
    notes, path = folder / NOTES_FILE, folder / "README.md"
    text = notes.read_text(encoding="utf-8") if notes.is_file() else ""
    heading = path.read_text(encoding="utf-8").split("\n")[0][2:] if path.is_file() else folder.name
    title = config["title"] or heading
    write_whole(path, page(study, tables, drawn, title=title, notes=text, folder=folder.name))
    log_line(f"{len(study.runs)} runs, written: {folder}")


if __name__ == "__main__":
    command("report", run)
