"""What a run survives: kills, a full disk, flipped bits. Longer than the suite.

``python tests/torture.py`` (about 20 minutes on a quiet machine) or ``--quick`` (about one).
Prints one line a class with its counts, in between what has been tried (on stderr), and leaves with
status 1 where a count is not as it must be. Classes named go alone, in any order and at any time:
``python tests/torture.py sweep`` draws the moments that the whole run draws for it.

kills         50 runs of every belief and algorithm, killed at random moments and resumed
sweep         8 kills of a sweep and its cells
full_disk     20 runs of which no file may grow beyond a random size
flipped_bits  800 flipped bits of a checkpoint

Every run is a process of its own that is killed by SIGKILL at a random moment, resumed, killed
again, and let go on to its end. It then equals the run that nobody stopped, to the last bit: its
tables and its last checkpoint. What can't go on says so in one line and leaves what was there.
"""

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "recipes"))
from recipe_tools import ROOT, make_config, resume, run, unequal
from training.checkpoint import checkpoint_frames, last_checkpoint, load_checkpoint
from training.config import explained
from training.console import log_line
from training.errors import UserError

SMALL = ("experiment=smoke", "total_frames=768", "checkpoint.every_frames=128",
         "missingness=mcar", "missingness.eta=0.3")  # fmt: skip
ACKTR = ("algo=acktr", "algo.critic.steps=3", "collector.num_envs=4", "collector.steps_per_env=32")
DVRL = ("belief.num_particles=3", "belief.hidden_dim=16", "belief.latent_dim=8")
CASES = {
    "drbpn": ("belief=drbpn",),
    "fill acktr": ("belief=fill", *ACKTR),
    "gru": ("belief=gru", "env=hopper", "missingness=mar"),
    "transformer": ("belief=transformer", "missingness=outages"),
    "none": ("belief=none", "missingness=nmar"),
    "fill": ("belief=fill", "noise=spikes"),
    "dvrl": ("belief=dvrl", *DVRL),
    "none acktr": ("belief=none", *ACKTR),
}


class Process:
    """A run in a fork of this process with everything imported; `log` takes what it prints."""

    def __init__(self, job, log):
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

    def ends(self, seconds=float("inf")):
        """Wait for its end; kill it after some seconds. Return its status; None where killed."""
        while time.perf_counter() - self.started < seconds:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.002)
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        return None

    def is_one_line(self):
        text = self.log.read_text(errors="replace")
        return text.count("error: ") == 1 and "Traceback" not in text


def starts(folder, words):
    """Return the job that starts a run, or goes on with it where it has got to a checkpoint."""
    if folder.exists() and checkpoint_frames(folder) is None:
        shutil.rmtree(folder)
    if folder.exists():
        return lambda: resume(folder)
    return lambda: run(folder, *SMALL, *words)


def finished(folder, words):
    """Take a run to its end; return how long that took."""
    process = Process(starts(folder, words), folder.with_suffix(".log"))
    status = process.ends()
    if status != 0:
        raise RuntimeError(f"{folder}: status {status}\n{process.log.read_text()}")
    return time.perf_counter() - process.started


def progress(text):
    print(f"  {text}", file=sys.stderr, flush=True)  # noqa: T201


def kills(work, draw, count):
    """Kill runs of every belief and algorithm at random moments."""
    wrong, stages, cases = [], Counter(), list(CASES.items())[: max(2, count // 6)]
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
    log_line(
        f"kills: {count} in {len(cases)} runs ({told}); runs unlike the one not killed: "
        f"{len({line.split(':')[0] for line in wrong})}"
    )
    return wrong


def sweep(work, draw, count):
    """Kill a sweep and its cells; the same command goes on."""

    def command(folder):
        words = ["study=smoke", f"hydra.sweep.dir={folder}"]
        log = folder.with_suffix(".log").open("ab")
        recipe = str(ROOT / "recipes" / "ppo_drbpn.py")
        return subprocess.Popen(
            [sys.executable, recipe, *words], cwd=work, stdout=log, stderr=log,
            start_new_session=True,
        )  # fmt: skip

    straight, killed = work / "sweep-straight", work / "sweep-killed"
    clock = time.perf_counter()
    if command(straight).wait():
        return [f"the sweep failed: {straight.with_suffix('.log').read_text()[-500:]}"]
    seconds = time.perf_counter() - clock
    for number in range(count):
        job = command(killed)
        try:
            job.wait(draw.uniform(0.2, 1) * seconds)
        except subprocess.TimeoutExpired:
            os.killpg(job.pid, signal.SIGKILL)
            job.wait()
        progress(f"sweep: kill {number + 1} of {count}")
    status = command(killed).wait()
    cells = sorted(path.name for path in straight.iterdir() if path.is_dir())
    wrong = [] if status == 0 else [f"the sweep ended with status {status}"]
    for cell in cells:
        wrong += [f"{cell}: {line}" for line in unequal(straight / cell, killed / cell)]
    log_line(
        f"sweep: {count} kills of {len(cells)} cells; cells unlike those not killed: "
        f"{len({line.split(':')[0] for line in wrong})}"
    )
    return wrong


def full_disk(work, draw, count):
    """Let no file grow beyond a random size, in a run that goes on from its middle."""
    straight, seed = work / "disk-straight", work / "disk-seed"
    finished(straight, CASES["drbpn"])
    shutil.copytree(straight, seed)
    last_checkpoint(seed).unlink()
    wrong, refused = [], 0
    size = last_checkpoint(seed).stat().st_size
    for number in range(count):
        folder = shutil.copytree(seed, work / f"disk-{number}")
        limit = draw.randrange(5000, size)  # what it says needs room too

        def job(folder=folder, limit=limit):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            return resume(folder)

        process = Process(job, work / "log")
        status = process.ends()
        if status != 2 or not process.is_one_line():
            wrong.append(f"limit {limit}: status {status}\n{process.log.read_text()[-800:]}")
        else:
            refused += 1
        finished(folder, CASES["drbpn"])
        wrong += [f"limit {limit}: {line}" for line in unequal(straight, folder)]
        shutil.rmtree(folder)
        progress(f"full disk: {number + 1} of {count}, {len(wrong)} wrong so far")
    log_line(
        f"full disk: {refused} of {count} ended in one line; went on unlike the one that had "
        f"room: {len(wrong) - (count - refused)}"
    )
    return wrong


def flipped_bits(work, draw, count):
    """Flip a bit of a checkpoint, with its sum beside it and without."""
    folder = work / "bits"
    finished(folder, CASES["drbpn"])
    path = last_checkpoint(folder)
    sums, whole = path.with_name(path.name + ".sha256"), path.read_bytes()
    kept, wrong = sums.read_text(), []
    loaded = Counter()
    for with_sum in (True, False):
        sums.write_text(kept) if with_sum else sums.unlink()
        for _ in range(count):
            place = draw.randrange(8 * len(whole))
            damaged = bytearray(whole)
            damaged[place // 8] ^= 1 << place % 8
            path.write_bytes(damaged)
            try:
                load_checkpoint(path)
            except UserError as error:
                if "\n" in str(error) or "go on from `frames_" not in str(error):
                    wrong.append(f"bit {place}: {error}")
            else:
                loaded[with_sum] += 1
                if with_sum:
                    wrong.append(f"bit {place} was loaded")
    log_line(
        f"flipped bits: {count - loaded[True]} of {count} refused, with the sum beside it; "
        f"by the archive's own sums {count - loaded[False]} of {count}"
    )
    return wrong


CLASSES = {
    "kills": (kills, 6, 50),
    "sweep": (sweep, 1, 8),
    "full_disk": (full_disk, 2, 20),
    "flipped_bits": (flipped_bits, 100, 400),
}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "classes", nargs="*", choices=[*CLASSES, []], help="all where none is given"
    )
    parser.add_argument("--quick", action="store_true", help="about a minute")
    parser.add_argument("--seed", type=int, default=0, help="of every random moment and place")
    words = parser.parse_args()
    make_config()  # imports what Hydra imports late, once for all forks
    wrong = []
    for name in words.classes or CLASSES:
        torment, few, many = CLASSES[name]
        with tempfile.TemporaryDirectory() as work:
            draw = random.Random(f"{words.seed} {name}")
            found = torment(Path(work), draw, few if words.quick else many)
        for line in found:
            log_line(f"WRONG {name}: {line}")
        wrong += found
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
