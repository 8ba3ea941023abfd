"""What a person sees: one progress bar, one line at the end, one line for an error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_drbpn import BeliefDivergedError
from training.errors import UserError

_USER_ERROR = 2


class ProgressBar:
    """Show frames, return, realised missing ratio, log-likelihood, speed, time left.

    Args:
        total_frames: environment steps of the whole run.
        frames: environment steps already taken.
    """

    def __init__(self, total_frames: int, frames: int) -> None:
        self._bar = tqdm(
            total=total_frames,
            initial=frames,
            unit="step",
            unit_scale=True,
            dynamic_ncols=True,
            smoothing=0.1,
            mininterval=1.0,
        )

    def __enter__(self) -> ProgressBar:
        """Show the bar."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the bar where it is."""
        self._bar.close()

    def update(self, row: Mapping[str, Any]) -> None:
        """Show the numbers of a rollout.

        Args:
            row: as logged.
        """
        shown = (
            ("return", "return", "{:.1f}"),
            ("missing", "missing_ratio", "{:.3f}"),
            ("log-lik", "log_likelihood", "{:.2f}"),
            ("steps/s", "steps_per_second", "{:.0f}"),
        )
        texts = [
            f"{name} {form.format(row[key])}"
            for name, key, form in shown
            if row.get(key) is not None
        ]
        self._bar.set_postfix_str(", ".join(texts), refresh=False)
        self._bar.update(row["frames"] - self._bar.n)

    def say(self, text: str) -> None:
        """Print a line above the bar.

        Args:
            text: the line.
        """
        self._bar.write(text)


def say(text: str) -> None:
    """Print a line.

    Args:
        text: the line.
    """
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def start(run: Callable[[dict[str, Any]], int], config: DictConfig) -> None:
    """Run what a command composed; leave with its status where it is not 0.

    Args:
        run: the command, on a plain configuration.
        config: what Hydra composed.
    """
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    status = run_or_explain(lambda: run(plain))
    if status:
        sys.exit(status)


def run_or_explain(job: Callable[[], int]) -> int:
    """Run a job; turn what the user can mend into one line on standard error.

    Args:
        job: returns an exit status.

    Returns:
        The job's status, or 2 for an error of the user's.
    """
    try:
        return job()
    # Such as an agent without its sensors, whose learned model then runs open loop.
    except (UserError, BeliefDivergedError) as error:
        sys.stderr.write(f"error: {error}\n")
        return _USER_ERROR
