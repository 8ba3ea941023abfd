"""What a person sees and how he stops a run: lines, progress, Ctrl-C."""

import os
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar

from tqdm import tqdm

# Environment variable: a file whose presence asks every cell of a sweep to stop.
STOP_FILE = "TORCHRL_DRBPN_STOP_FILE"


def log_line(text: str) -> None:
    """Print a line; nobody has to be listening."""
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # What is written later, and at the end of the process, goes nowhere too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# Without tqdm's own rate, so that a terminal of 100 columns has room for a bar.
BAR = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"


def show(bar: "tqdm[Any]", row: Mapping[str, Any]) -> None:
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
    """Whether a signal asked the run to stop, or its sweep to, which may be another process.

    The run then stops where its state is whole, after the update of the current rollout; a second
    signal ends the process as usual. ``file`` is made when the signal comes, for other processes.
    """

    current: ClassVar["StopRequest | None"] = None

    def __init__(self, file: Path | None) -> None:
        self.file = file
        self.signal: int | None = None
        self._sweep = os.environ.get(STOP_FILE)
        signals = (signal.SIGINT, signal.SIGTERM)
        self._before: dict[int, Any] = {n: signal.signal(n, self._remember) for n in signals}

    def __bool__(self) -> bool:
        """Return whether a stop was asked for."""
        return self.exit_code != 0

    @property
    def exit_code(self) -> int:
        """Return the shell's status for the signal: 130 for Ctrl-C, 143 for SIGTERM, else 0."""
        if self.signal is not None:
            return 128 + self.signal
        return 128 + signal.SIGTERM if self._sweep and os.path.exists(self._sweep) else 0

    def restore(self) -> None:
        """Give both signals back."""
        while self._before:
            signal.signal(*self._before.popitem())

    def _remember(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.signal = number
        self.restore()
        if self.file is not None:
            self.file.touch()


@contextmanager
def stop_request(file: Path | None = None) -> Iterator[StopRequest]:
    """Watch for signals while this context is open; inside another one it is the same request."""
    if StopRequest.current is not None:
        yield StopRequest.current
        return
    StopRequest.current = request = StopRequest(file)
    try:
        yield request
    finally:
        request.restore()
        StopRequest.current = None
