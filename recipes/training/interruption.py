"""Ctrl-C and SIGTERM: finish the rollout, save, leave."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any


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
