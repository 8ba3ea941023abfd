"""Runs that are killed by SIGKILL at random moments and resumed. Longer than the suite.

``python tests/torture.py`` (about 10 minutes on a quiet machine) or ``--quick`` (about one) kills
runs of every belief and algorithm, each a process of its own: killed, resumed, killed again, and
let go on to its end. It then equals the run that nobody stopped, to the last bit: its tables and
its last checkpoint. Prints the counts, in between what has been tried (on stderr), and leaves with
status 1 where a run is unlike.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "recipes"))
from recipe_tools import differences, make_config, read_table, resume, run
from training.checkpoint import checkpoint_frames, last_checkpoint, load_checkpoint
from training.config import explained
from training.console import say

TABLES = ("metrics.csv", "episodes.csv", "evaluation.csv")
SMALL = ("experiment=smoke", "total_frames=768", "checkpoint.every_frames=128",
         "missingness=mcar", "missingness.eta=0.3")  # fmt: skip
DVRL = ("belief.num_particles=3", "belief.hidden_dim=16", "belief.latent_dim=8")
CASES = {
    "drbpn": ("belief=drbpn",),
    "fill acktr": ("belief=fill", "algo=acktr", "algo.critic.steps=3", "collector.num_envs=4",
                   "collector.steps_per_env=32"),
    "gru": ("belief=gru", "env=hopper", "missingness=mar"),
    "transformer": ("belief=transformer", "missingness=outages"),
    "none": ("belief=none", "missingness=nmar"),
    "fill": ("belief=fill", "noise=spikes"),
    "dvrl": ("belief=dvrl", *DVRL),
    "none acktr": ("belief=none", "algo=acktr", "algo.critic.steps=3", "collector.num_envs=4",
                   "collector.steps_per_env=32"),
}  # fmt: skip


class Process:
    """A run in a fork of this process, which has imported everything and trained nothing.

    Args:
        job: what it does.
        log: takes what it prints.
    """

    def __init__(self, job: Callable[[], int], log: Path) -> None:
        self.log, self.started = log, time.perf_counter()
        sys.stdout.flush()
        self.pid = os.fork()
        if self.pid:
            return
        status = 70
        try:
            file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, 1)
            os.dup2(file, 2)
            status = explained(job)
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)

    def ends(self, seconds: float = float("inf")) -> int | None:
        """Wait for its end; kill it after some seconds. Return its status; None where killed."""
        while time.perf_counter() - self.started < seconds:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.002)
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        return None


def starts(folder: Path, words: tuple[str, ...]) -> Callable[[], int]:
    """Return the job that starts a run, or goes on with it where it has got to a checkpoint."""
    if folder.exists() and checkpoint_frames(folder) is None:
        shutil.rmtree(folder)
    if folder.exists():
        return lambda: resume(folder)
    return lambda: run(folder, *SMALL, *words)


def finished(folder: Path, words: tuple[str, ...]) -> float:
    """Take a run to its end; return how long that took."""
    process = Process(starts(folder, words), folder.with_suffix(".log"))
    status = process.ends()
    if status != 0:
        raise RuntimeError(f"{folder}: status {status}\n{process.log.read_text()}")
    return time.perf_counter() - process.started


def unequal(first: Path, second: Path) -> list[str]:
    """Name what differs in two runs that have ended."""
    found = [t for t in TABLES if read_table(first / t) != read_table(second / t)]
    states = [load_checkpoint(last_checkpoint(folder)) for folder in (first, second)]
    return found + differences(*states)


def progress(text: str) -> None:
    """Print how far it has got."""
    print(f"  {text}", file=sys.stderr, flush=True)  # noqa: T201


def kills(work: Path, draw: random.Random, count: int) -> list[str]:
    """Kill runs of every belief and algorithm at random moments."""
    wrong, stages, cases = [], Counter[str](), list(CASES.items())[: max(2, count // 6)]
    for number, (name, words) in enumerate(cases):
        straight, killed = work / f"straight-{number}", work / f"killed-{number}"
        seconds = finished(straight, words)
        share = count // len(cases) + (number < count % len(cases))
        for _ in range(share):
            ended = Process(starts(killed, words), work / "log").ends(draw.uniform(0, seconds))
            there = killed.exists() and checkpoint_frames(killed)
            stage = "before the first checkpoint" if not there else "between checkpoints"
            stages[stage if ended is None else "at the end"] += 1
            if ended is not None:  # from the start again
                said = (work / "log").read_text()[-800:]
                unlike = [f"status {ended}\n{said}"] if ended else unequal(straight, killed)
                wrong += [f"{name}: {line}" for line in unlike]
                shutil.rmtree(killed, ignore_errors=True)
        finished(killed, words)
        different = unequal(straight, killed)
        left = [str(path) for path in killed.rglob(".*.tmp*")]
        wrong += [f"{name}: {line}" for line in different + left]
        progress(f"kills: {name}: {share}, {len(wrong)} wrong so far")
    told = ", ".join(f"{n} {stage}" for stage, n in sorted(stages.items()))
    say(
        f"kills: {count} in {len(cases)} runs ({told}); runs unlike the one not killed: "
        f"{len({line.split(':')[0] for line in wrong})}"
    )
    return wrong


def main() -> int:
    """Kill the runs; return the status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="about a minute")
    parser.add_argument("--seed", type=int, default=0, help="of every random moment")
    words = parser.parse_args()
    make_config()  # imports what Hydra imports late, once for all forks
    with tempfile.TemporaryDirectory() as work:
        wrong = kills(Path(work), random.Random(words.seed), 6 if words.quick else 50)
    for line in wrong:
        say(f"WRONG {line}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
