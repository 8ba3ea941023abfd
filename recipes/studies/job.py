"""A study as one job: cells as processes, some at a time, until all are done or it is stopped."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from training.console import say
from training.errors import UserError
from training.interruption import StopRequest

from studies.cells import StudyFolder, write_process
from studies.grid import Cell
from studies.status import duration, expected_speeds, seconds_left

_RECIPE = Path(__file__).parents[1] / "ppo_drbpn.py"
_POLL = 0.5  # s
# Ends that say nothing about the run: somebody, or the system, put an end to its process.
_CUT_OFF = {
    *(-number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP)),
    *(128 + number for number in (signal.SIGINT, signal.SIGTERM)),
}
# Two studies' worth of threads on the cores of one would only get into each other's way.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass
class StudyJob:
    """Run the cells of a study.

    Attributes:
        folder: of the study.
        cells: in the order in which they are started.
        at_once: processes at a time.
        retry_failed: whether cells that failed before are started again.
        status_seconds: between two reports of what is running, s.
    """

    folder: StudyFolder
    cells: Sequence[Cell]
    at_once: int
    retry_failed: bool
    status_seconds: float
    _queue: list[Cell] = field(default_factory=list)
    _own: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    _found: dict[str, Cell] = field(default_factory=dict)  # an earlier study.py started them
    _done: set[str] = field(default_factory=set)
    _cut_off: set[str] = field(default_factory=set)
    _speeds: dict[str, float] = field(default_factory=dict)

    # Looking --------------------------------------------------------------------------------------

    def look(self) -> None:
        """Read from disk what is done, running, and to be done.

        Raises:
            UserError: if a folder was made with other overrides, or a cell's can't be used.
        """
        for cell in self.cells:
            self.folder.check(cell)
        failures = self.folder.failures()
        for cell in self.cells:
            if self.folder.running(cell):
                self._found[cell.name] = cell
            elif self.folder.finished(cell):
                self._done.add(cell.name)
            elif cell.name not in failures or self.retry_failed:
                # Before the first cell has run for hours, not after.
                if not self.folder.resumable(cell):
                    cell.settings()
                self._queue.append(cell)

    def show(self) -> None:
        """Print how far every cell is, and the command of each that is to be started."""
        self._report()
        failures = self.folder.failures()
        for cell in self.cells:
            if cell.name in self._found:
                continue  # has its line already
            if cell.name in self._done:
                say(f"  done     {cell.name}: {self._reached(cell)}")
                continue
            state = "failed" if cell.name in failures and cell not in self._queue else "queued"
            say(f"  {state:8s} {cell.name}: {shlex.join(['python', *self._command(cell)[1:]])}")

    def _reached(self, cell: Cell) -> str:
        measured = self.folder.measured(cell)
        frames = measured.frames if measured else self.folder.total_frames(cell)
        text = f"{frames:,} steps"
        known = measured is not None and measured.mean_return is not None
        return f"{text}, return {measured.mean_return:.1f}" if measured and known else text

    # Running --------------------------------------------------------------------------------------

    def run(self) -> int:
        """Start what is to be done, and wait for it.

        Returns:
            0 where every cell is done, 1 where one failed or was cut off, 130 or 143 where Ctrl-C
            or SIGTERM stopped the study.
        """
        self._report()
        reported = time.monotonic()
        # Its runs would go on by themselves if this process ended before it has asked them.
        with StopRequest(patient=True) as stop:
            while not stop and (self._queue or self._own or self._found):
                while self._queue and len(self._own) + len(self._found) < self.at_once:
                    self._start(self._queue.pop(0))
                time.sleep(_POLL)
                if self._reap() or time.monotonic() - reported > self.status_seconds:
                    self._report()
                    reported = time.monotonic()
            if stop:
                self._stop()
        if stop:
            return stop.exit_code
        failures = self.folder.failures()
        for cell in self.cells:
            if cell.name in failures:
                say(f"failed: {cell.name}: {failures[cell.name]} (log: {self.folder.log(cell)})")
        return 0 if len(self._done) == len(self.cells) else 1

    def _start(self, cell: Cell) -> None:
        resumed = self.folder.resumable(cell)
        lock = self.folder.lock_cell(cell)
        try:
            self.folder.prepare(cell)
            log = self.folder.log(cell)
            log.parent.mkdir(parents=True, exist_ok=True)
            with log.open("ab") as output:
                # A session of its own: Ctrl-C reaches this process alone, which then asks each
                # run once. A second request would end a run before it has saved.
                process = subprocess.Popen(
                    self._command(cell),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=_environment(),
                    start_new_session=True,
                    pass_fds=[lock],
                )
            write_process(lock, process.pid)
        finally:
            os.close(lock)
        self.folder.record_failure(cell, None)
        self._own[cell.name] = process
        say(f"{'going on with' if resumed else 'started'} {cell.name}")

    def _command(self, cell: Cell) -> list[str]:
        folder = self.folder.run_folder(cell)
        python = [sys.executable, str(_RECIPE)]
        if self.folder.resumable(cell):
            frames = self.folder.total_frames(cell)
            return [*python, f"resume={_quoted(folder)}", f"total_frames={frames}"]
        return [*python, *cell.overrides, f"hydra.run.dir={_quoted(folder)}"]

    def _reap(self) -> bool:
        """Take note of the processes that have ended; return whether there was one."""
        ended = {name: p.returncode for name, p in self._own.items() if p.poll() is not None}
        for name, code in ended.items():
            del self._own[name]
            self._judge(next(cell for cell in self.cells if cell.name == name), code)
        gone = [cell for cell in self._found.values() if not self.folder.running(cell)]
        for cell in gone:
            del self._found[cell.name]
            if self.folder.finished(cell):
                self._done.add(cell.name)
                say(f"done {cell.name}")
            else:
                self._queue.insert(0, cell)  # how it ended is not known: one more try tells
        return bool(ended or gone)

    def _judge(self, cell: Cell, code: int) -> None:
        if self.folder.finished(cell):
            self._done.add(cell.name)
            say(f"done {cell.name}")
        elif code in _CUT_OFF:
            self._cut_off.add(cell.name)
            say(f"cut off {cell.name}: its process was ended from outside; the next call goes on")
        else:
            line = self.folder.last_line(cell) if code else "ended without a final evaluation"
            self.folder.record_failure(cell, line)
            say(f"failed {cell.name}, status {code}: {line}")

    def _stop(self) -> None:
        """Ask every run once to save and leave, and wait for it."""
        say(f"stopping: {len(self._own) + len(self._found)} runs save and leave, in seconds")
        numbers = [process.pid for process in self._own.values()]
        numbers += [n for n in map(self.folder.process_of, self._found.values()) if n is not None]
        for number in numbers:
            try:
                os.kill(number, signal.SIGTERM)
            except ProcessLookupError:
                continue  # has just ended
        for process in self._own.values():
            process.wait()
        while any(self.folder.process_of(cell) is not None for cell in self._found.values()):
            time.sleep(_POLL)
        say("stopped; the same command goes on")

    # Reporting ------------------------------------------------------------------------------------

    def _report(self) -> None:
        running = [c for c in self.cells if c.name in self._own or c.name in self._found]
        failed = self.folder.failures().keys() - {c.name for c in (*self._queue, *running)}
        counts = {
            "done": len(self._done),
            "running": len(running),
            "queued": len(self._queue),
            "failed": len(failed & {c.name for c in self.cells}),
            "cut off": len(self._cut_off),
        }
        text = ", ".join(f"{n} {what}" for what, n in counts.items() if n or what != "cut off")
        lines, left = self._lines(running)
        if left is not None:
            text += f"; about {duration(left)} of training left"
        say("\n".join([f"{self.folder.path.name}: {text}", *lines]))

    def _lines(self, running: Sequence[Cell]) -> tuple[list[str], float | None]:
        """Return a line a running cell, and the seconds left of the study where they are known."""
        for cell in self.cells:
            # A finished run is measured once; one in the queue may have run before.
            if cell.name not in self._speeds or cell.name not in self._done:
                measured = self.folder.measured(cell)
                if measured is not None and measured.speed is not None:
                    self._speeds[cell.name] = measured.speed
        speeds = expected_speeds(self.cells, self._speeds)

        def left(cell: Cell) -> float:
            measured = self.folder.measured(cell)
            done = measured.frames if measured else 0
            return max(0, self.folder.total_frames(cell) - done) / speeds[cell.name]

        lines = []
        for cell in running:
            measured = self.folder.measured(cell)
            if measured is None:
                lines.append(f"  running  {cell.name}: starting")
                continue
            parts = [f"{measured.frames:,} of {self.folder.total_frames(cell):,} steps"]
            if measured.speed is not None:
                parts.append(f"{measured.speed:,.0f} steps/s")
            if measured.mean_return is not None:
                parts.append(f"return {measured.mean_return:.1f}")
            if cell.name in speeds:
                parts.append(f"about {duration(left(cell))} left")
            lines.append(f"  running  {cell.name}: {', '.join(parts)}")
        if not speeds or not (running or self._queue):
            return lines, None
        return lines, seconds_left(map(left, running), map(left, self._queue), self.at_once)


def _environment() -> Mapping[str, str]:
    # The log keeps lines, not a progress bar that is drawn anew every second.
    return {**os.environ, **_ONE_THREAD, "TQDM_DISABLE": "1"}


def _quoted(folder: Path) -> str:
    """Return a path as a value in Hydra's grammar."""
    text = str(folder)
    if "'" in text:
        raise UserError(f"`folder` must be a path without an apostrophe, got {text}.")
    return text if all(c.isalnum() or c in "/._-" for c in text) else f"'{text}'"
