"""What a person sees and how he stops a run: lines, progress, Ctrl-C."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, ClassVar, Self

from tqdm import tqdm

# Environment variable: a file whose presence asks every cell of a sweep to stop.
STOP_FILE = "TORCHRL_DRBPN_STOP_FILE"


def say(text: str) -> None:
    """Print a line; nobody has to be listening."""
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # What is written later, and at the end of the process, goes nowhere too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# Without tqdm's own rate, so that a terminal of 100 columns has room for a bar.
BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"


def show(bar: tqdm[Any], row: Mapping[str, Any]) -> None:
    """Show frames, return, realised missing ratio, log-likelihood and speed in a progress bar."""
    shown = {
        "return": "return {:.4g}",
        "missing_ratio": "missing {:.2f}",
        "log_likelihood": "log-lik {:.2f}",
        "steps_per_second": "{:.0f} steps/s",
    }
    texts = [form.format(row[key]) for key, form in shown.items() if row.get(key) is not None]
    bar.set_postfix_str(", ".join(texts), refresh=False)
    bar.update(row["frames"] - bar.n)


class StopRequest:
    """Remember that a signal asked the run to stop, while this context is open.

    The first signal is remembered and nothing else happens, so that the run stops where its state
    is whole: after the update of the current rollout. A second one ends the process as usual. One
    inside another hands its signal on to it; a cell of a sweep also stops with its sweep, which may
    be another process: ``file`` is made when the signal comes, for those that look for it.
    """

    innermost: ClassVar[StopRequest | None] = None

    def __init__(self, file: Path | None = None) -> None:
        self.file = file
        self.signal: int | None = None
        self._outer: StopRequest | None = None
        self._sweep = os.environ.get(STOP_FILE)
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Take over both signals."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._remember)
        self._outer, StopRequest.innermost = StopRequest.innermost, self
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give both signals back."""
        self._restore()
        StopRequest.innermost = self._outer

    def __bool__(self) -> bool:
        """Return whether a stop was asked for."""
        return self.exit_code != 0

    @property
    def exit_code(self) -> int:
        """Return the shell's status for the signal: 130 for Ctrl-C, 143 for SIGTERM, else 0."""
        if self.signal is not None:
            return 128 + self.signal
        if self._outer is not None:
            return self._outer.exit_code
        return 128 + signal.SIGTERM if self._sweep and os.path.exists(self._sweep) else 0

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        self._restore()
        if self.file is not None:
            self.file.touch()
        if self._outer is not None:
            self._outer._remember(number, frame)

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)
