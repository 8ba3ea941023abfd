"""What a person sees and how he stops a run: lines, progress, Ctrl-C."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Mapping
from types import FrameType, TracebackType
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm


def say(text: str) -> None:
    """Print a line; nobody has to be listening.

    Args:
        text: the line.
    """
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # What is written later, and at the end of the process, goes nowhere too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def start(run: Callable[[dict[str, Any]], int], config: DictConfig) -> None:
    """Run what a command composed; leave with its status where it is not 0.

    Args:
        run: the command, on a plain configuration.
        config: what Hydra composed.
    """
    status = run(cast(dict[str, Any], OmegaConf.to_container(config, resolve=True)))
    if status:
        sys.exit(status)


def show(bar: tqdm[Any], row: Mapping[str, Any]) -> None:
    """Show frames, return, realised missing ratio, log-likelihood and speed in a progress bar.

    Args:
        bar: the bar.
        row: numbers of a rollout.
    """
    shown = (
        ("return", "return", "{:.1f}"),
        ("missing", "missing_ratio", "{:.3f}"),
        ("log-lik", "log_likelihood", "{:.2f}"),
        ("steps/s", "steps_per_second", "{:.0f}"),
    )
    texts = [f"{n} {form.format(row[key])}" for n, key, form in shown if row.get(key) is not None]
    bar.set_postfix_str(", ".join(texts), refresh=False)
    bar.update(row["frames"] - bar.n)


class StopRequest:
    """Remember that a signal asked the run to stop, while this context is open.

    The first signal is remembered and nothing else happens, so that the run stops where its state
    is whole: after the update of the current rollout. A second one ends the process as usual.

    Args:
        patient: whether a second one is ignored instead.
    """

    def __init__(self, *, patient: bool = False) -> None:
        self.patient = patient
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        """Take over both signals."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._remember)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give both signals back."""
        self._restore()

    def __bool__(self) -> bool:
        """Return whether a stop was asked for."""
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """Return the shell's status for the signal: 130 for Ctrl-C, 143 for SIGTERM, else 0."""
        return 0 if self.signal is None else 128 + self.signal

    def _remember(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.signal = number
        if not self.patient:
            self._restore()

    def _restore(self) -> None:
        while self._before:
            number, handler = self._before.popitem()
            signal.signal(number, handler)
