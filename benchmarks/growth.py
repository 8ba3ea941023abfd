"""How do time and memory of the filter grow with its sizes?

Forward + backward of BeliefFilter, one size varied at a time around time 16 x batch 16, obs 17,
state 17, action 6. Milliseconds are medians; the memory is the rise of the peak resident size in a
process of its own. The exponent is the slope of log(ms) against log(size) from the size above:
1 is linear, 2 quadratic.
"""

from __future__ import annotations

import math
import multiprocessing
import resource
from multiprocessing.connection import Connection

import torch
from timing import CLOCKS, finish, interleave, parser, start, table

from torchrl_drbpn import BeliefFilter

ACTION = 6
BASE = {"time": 16, "batch": 16, "obs": 17, "state": 17}
VARIED = {
    "time": (16, 64, 256, 1024),
    "batch": (16, 64, 256, 1024),
    "obs": (11, 17, 45, 105, 348),
    "state": (8, 16, 32, 64, 128),
}


class Pass:
    """Forward + backward at one size."""

    def __init__(self, time: int, batch: int, obs: int, state: int) -> None:
        torch.manual_seed(0)
        self.filter = BeliefFilter(obs, ACTION, state)
        self.inputs = (
            torch.zeros(batch, state),
            None,
            torch.rand(batch, time, ACTION) * 2 - 1,
            torch.randn(batch, time, obs),
            torch.rand(batch, time, obs) > 0.3,
            torch.rand(batch, time) < 0.02,
        )

    def __call__(self) -> None:
        """Run once."""
        for parameter in self.filter.parameters():
            parameter.grad = None
        out = self.filter(*self.inputs)
        torch.autograd.backward(out.mean.square().mean() - out.log_likelihood.mean())


def _peak() -> float:
    """Return the peak resident size of this process, MiB (Linux counts in KiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _measure_memory(sizes: dict[str, int], threads: int, pipe: Connection) -> None:
    torch.set_num_threads(threads)
    # One small pass first, so that what is loaded on first use does not count.
    Pass(2, 2, 3, 3)()
    once = Pass(**sizes)
    before = _peak()
    once()
    pipe.send(_peak() - before)


def peak_memory(sizes: dict[str, int], threads: int) -> float:
    """Return by how much one pass raises the peak resident size of a fresh process, MiB.

    The process is forked from one that has run no backward pass and holds no threads.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_measure_memory, args=(sizes, threads, sender))
    child.start()
    sender.close()
    try:
        value = receiver.recv()
    except EOFError as error:
        raise RuntimeError(f"the process that measured {sizes} died") from error
    child.join()
    return float(value)


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "").parse_args()
    run = start(args)
    rounds = args.rounds or (2 if args.quick else 7)
    varied: dict[str, tuple[int, ...]] = dict(VARIED)
    if args.quick:
        varied = {"time": (4, 8)}
    points = {
        f"{name} {value}": BASE | {name: value}
        for name, values in varied.items()
        for value in values
    }
    # Memory first: the processes are forked before this one has grown.
    memory = {name: peak_memory(sizes, args.threads) for name, sizes in points.items()}
    times = interleave(
        {name: Pass(**sizes) for name, sizes in points.items()},
        rounds=rounds,
        sample_seconds=0.0 if args.quick else 0.02,
        clock=CLOCKS[args.clock],
    )
    results = {}
    for name, values in varied.items():
        rows: list[tuple[object, ...]] = []
        last: tuple[int, float] | None = None
        for value in values:
            point = f"{name} {value}"
            ms = 1e3 * times.median(point)
            exponent: float | str = ""
            if last is not None:
                exponent = math.log(ms / last[1]) / math.log(value / last[0])
            rows.append((value, ms, times.percent(point), exponent, memory[point]))
            last = (value, ms)
            results[point] = {"ms": ms, "peak_mib": memory[point]}
        fixed = ", ".join(f"{k} {v}" for k, v in BASE.items() if k != name)
        table(f"growth with {name} ({fixed})", (name, "ms", "+-", "exponent", "peak MiB"), rows)
    finish(args, run, results)


if __name__ == "__main__":
    main()
