"""What is on disk about a cell of a study. The run folder is the truth; nothing is kept twice."""

from __future__ import annotations

import csv
import fcntl
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from training.checkpoint import checkpoint_frames
from training.errors import UserError
from training.run_folder import CELL_FILE, read_config, write_whole

from studies.grid import Cell, differing

_TAIL = 8192  # bytes: longer than any line of a table or log that is read from its end


@dataclass(frozen=True)
class Measured:
    """How far a run is.

    Attributes:
        frames: environment steps so far.
        speed: environment steps a second over the whole run, evaluation left out; None: not known.
        mean_return: as logged last; None before the first episode has ended.
    """

    frames: int
    speed: float | None
    mean_return: float | None


@dataclass(frozen=True)
class StudyFolder:
    """Where a study lies: a run folder a cell, logs, locks, and what failed.

    Attributes:
        path: of the folder.
    """

    path: Path

    def __post_init__(self) -> None:
        """Refuse a path that can not be a folder."""
        present = next(p for p in (self.path, *self.path.absolute().parents) if p.exists())
        if not present.is_dir():
            raise UserError(f"`folder` must be a folder or free for one; `{present}` is a file.")

    def run_folder(self, cell: Cell) -> Path:
        """Return the run folder of a cell."""
        return self.path / cell.name

    def log(self, cell: Cell) -> Path:
        """Return the file that holds what a cell's process has printed."""
        return self.path / "logs" / f"{cell.name}.log"

    # Started, finished --------------------------------------------------------------------------

    def check(self, cell: Cell) -> None:
        """Check that what is on disk about a cell has been made with its overrides.

        Args:
            cell: of the study.

        Raises:
            UserError: if it has been made with others, or by something else than a study.
        """
        folder = self.run_folder(cell)
        if not folder.is_dir() or all(path.name.startswith(".") for path in folder.iterdir()):
            return
        names = differing(_recorded(folder), cell.overrides)
        if names:
            raise UserError(
                f"`{folder}` was run with other overrides than the study has now; they differ in "
                f"{', '.join(names[:5])}. Move the folder away, or give the study another name."
            )

    def total_frames(self, cell: Cell) -> int:
        """Return how many environment steps a cell shall take."""
        given = [w.split("=", 1)[1] for w in cell.overrides if w.startswith("total_frames=")]
        if given:
            return int(float(given[0].replace("_", "")))
        folder = self.run_folder(cell)
        if (folder / "config.yaml").is_file():
            return int(read_config(folder)["total_frames"])
        return cell.settings().total_frames

    def finished(self, cell: Cell) -> bool:
        """Return whether a cell has taken all its steps and made its final evaluation."""
        folder = self.run_folder(cell)
        if not (folder / "config.yaml").is_file():
            return False
        config = read_config(folder)
        frames = checkpoint_frames(folder)
        if frames is None or frames < config["total_frames"]:
            return False
        if config["total_frames"] != self.total_frames(cell):
            return False
        evaluation = config["evaluation"]
        if not evaluation["final_episodes"]:
            return True
        return set(evaluation["modes"]) <= _final_modes(folder / "evaluation.csv", frames)

    def resumable(self, cell: Cell) -> bool:
        """Return whether a cell has a checkpoint to go on from."""
        folder = self.run_folder(cell)
        return (folder / "config.yaml").is_file() and checkpoint_frames(folder) is not None

    def prepare(self, cell: Cell) -> None:
        """Make the run folder of a cell ready for its process.

        What a run left that has no checkpoint is removed, and what the cell is is written down.

        Args:
            cell: to be started.
        """
        folder = self.run_folder(cell)
        # Hidden at once, removed at leisure: half a folder without cell.json would look like
        # somebody else's to the call that goes on.
        hidden = self.path / f".{cell.name}.removed"
        if hidden.exists():
            shutil.rmtree(hidden)  # an earlier call was killed at this point
        if folder.exists() and not self.resumable(cell):
            folder.rename(hidden)
            shutil.rmtree(hidden)
        folder.mkdir(parents=True, exist_ok=True)
        about = {
            "study": self.path.name,
            "choices": dict(cell.choices),
            "overrides": list(cell.overrides),
        }
        write_whole(folder / CELL_FILE, json.dumps(about, indent=2) + "\n")

    def measured(self, cell: Cell) -> Measured | None:
        """Return how far a cell is; None where its first rollout is not over."""
        row = _last_row(self.run_folder(cell) / "metrics.csv")
        try:
            frames, seconds = int(row["frames"]), float(row["wall_time"] or 0)
            mean_return = float(row["return"]) if row["return"] else None
        except (KeyError, ValueError):
            return None
        return Measured(frames, frames / seconds if seconds > 0 else None, mean_return)

    # Running ------------------------------------------------------------------------------------

    def lock(self) -> int:
        """Take the study for this process until it ends.

        Returns:
            A file descriptor that holds the lock.

        Raises:
            UserError: if another process has it.
        """
        self._lock.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(self._lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(file)
            raise UserError(
                f"`{self.path}` is in use by another study.py (process {self.process()}): wait or "
                "stop it; dry_run=true shows how far it is."
            ) from error
        _write_pid(file, os.getpid())
        return file

    def lock_cell(self, cell: Cell) -> int:
        """Take a cell. The lock goes over to the process that inherits the file descriptor.

        So the cell is taken for as long as its process lives, whatever becomes of the study's.

        Args:
            cell: to be started.

        Returns:
            A file descriptor that holds the lock.
        """
        path = self._lock_file(cell)
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        fcntl.flock(file, fcntl.LOCK_EX)
        os.ftruncate(file, 0)
        return file

    def running(self, cell: Cell) -> bool:
        """Return whether a process works on a cell, of this study.py or of an earlier one."""
        return _held(self._lock_file(cell))

    def process(self) -> int | None:
        """Return the study.py that works on this study, where one does."""
        return _holder(self._lock)

    def process_of(self, cell: Cell) -> int | None:
        """Return the process that works on a cell, where one does and its number is known."""
        return _holder(self._lock_file(cell))

    @property
    def _lock(self) -> Path:
        return self.path / "locks" / "study"

    def _lock_file(self, cell: Cell) -> Path:
        return self.path / "locks" / f"{cell.name}.cell"

    # Failed -------------------------------------------------------------------------------------

    def failures(self) -> dict[str, str]:
        """Return the last line of the log of each cell that failed, by name."""
        try:
            read = json.loads((self.path / "failed.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except ValueError:
            read = None
        if not isinstance(read, dict):
            raise UserError(f"`{self.path / 'failed.json'}` can't be read: remove it.")
        return {str(name): str(line) for name, line in read.items()}

    def record_failure(self, cell: Cell, line: str | None) -> None:
        """Write down that a cell failed.

        Args:
            cell: which.
            line: the last of its log; None: it has not failed any more.
        """
        before = self.failures()
        failures = {name: text for name, text in before.items() if name != cell.name}
        if line is not None:
            failures[cell.name] = line
        if failures == before:
            return
        write_whole(self.path / "failed.json", json.dumps(failures, indent=2) + "\n")

    def last_line(self, cell: Cell) -> str:
        """Return the last line that a cell's process has printed."""
        lines = [line.strip() for line in re.split(r"[\r\n]", _tail(self.log(cell)))]
        return next((line for line in reversed(lines) if line), "it printed nothing")


def write_process(file: int, process: int) -> None:
    """Write into the lock of a cell which process holds it.

    Args:
        file: of :meth:`StudyFolder.lock_cell`.
        process: its number.
    """
    _write_pid(file, process)


def _held(path: Path) -> bool:
    """Return whether a process holds a lock."""
    try:
        file = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False


def _holder(path: Path) -> int | None:
    """Return the process that holds a lock, where one does and its number is known."""
    try:
        number = int(path.read_text())
    except (OSError, ValueError):
        return None
    return number if _held(path) else None


def _write_pid(file: int, process: int) -> None:
    os.ftruncate(file, 0)
    os.pwrite(file, str(process).encode(), 0)


def _recorded(folder: Path) -> list[str]:
    """Return the overrides that a run folder was made with."""
    path = folder / CELL_FILE
    try:
        return [str(word) for word in json.loads(path.read_text(encoding="utf-8"))["overrides"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"`{folder}` is in the way of a cell, and no study has made it ({CELL_FILE} is not "
            "there or can't be read): move it away."
        ) from error


def _final_modes(path: Path, frames: int) -> set[str]:
    """Return the kinds of action that the final evaluation has whole rows of."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return {
                row["mode"]
                for row in csv.DictReader(file)
                if None not in row.values()
                and row["kind"] == "final"
                and row["frames"] == str(frames)
            }
    except (OSError, KeyError, UnicodeDecodeError):
        return set()


def _last_row(path: Path) -> Mapping[str, str]:
    """Return the last whole row of a table, which may be growing."""
    try:
        with path.open(encoding="utf-8") as file:
            columns = file.readline().rstrip("\n").split(",")
    except (OSError, UnicodeDecodeError):
        return {}
    lines = _tail(path).split("\n")[:-1]  # what comes after the last line's end is not whole
    cells = lines[-1].split(",") if lines else []
    return dict(zip(columns, cells, strict=True)) if len(cells) == len(columns) else {}


def _tail(path: Path) -> str:
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            return file.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
