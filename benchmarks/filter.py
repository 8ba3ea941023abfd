"""How fast is the filter, forward and backward, against the recurrent modules one could take?

Two comparisons over [batch, time], 30 % of the entries missing, 2 % of the steps an episode start:

- on tensors: BeliefFilter against nn.GRU and nn.LSTM of width 64, which know no resets (the least
  that a GRUModule can cost);
- on TensorDicts: BeliefFilterModule against GRUModule (backends pad and scan) and LSTMModule.

Ratios are times over GRU's; under 1 the filter is the faster one.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from timing import CLOCKS, Times, finish, interleave, parser, start, table, verdict
from torch import nn
from torchrl.modules import GRUModule, LSTMModule, set_recurrent_mode

from torchrl_drbpn import BeliefFilter, BeliefFilterModule

WIDTH = 64
ACTION = 6

# (time, batch, obs, state) and the ratio to GRU that has to be reached / is aimed at.
TARGETS = {
    (16, 16, 17, 17): (1.0, 1.0),
    (16, 16, 17, 64): (1.0, 1.0),
    (32, 32, 17, 17): (1.0, 1.0),
    (32, 32, 17, 64): (1.0, 1.0),
    (16, 16, 105, 16): (2.0, 1.0),
    (16, 16, 105, 32): (2.0, 1.0),
    (32, 32, 105, 16): (2.0, 1.0),
    (32, 32, 105, 32): (2.0, 1.0),
}
GRID = {
    (time, 16, obs, state): None
    for obs in (11, 17, 105)
    for state in (16, 32, 64)
    for time in (16, 64, 256)
}


def make_data(time: int, batch: int, obs: int, state: int) -> TensorDict:
    """Make inputs of every module, from a seed of their own."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(batch, time, *shape, generator=generator)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(batch, time, *shape, generator=generator)

    observed = uniform(obs) > 0.3
    is_init = uniform(1) < 0.02
    # An age that agrees with is_init, as the collector stores it.
    age = torch.ones(batch, time, 1, dtype=torch.int64).masked_fill_(is_init, 0)
    return TensorDict(
        {
            "observation": normal(obs) * observed,
            "observed": observed,
            "previous_action": normal(ACTION).clamp(-1, 1),
            "is_init": is_init,
            ("recurrent", "mean"): 0.1 * normal(state),
            ("recurrent", "age"): age,
            "gru": torch.zeros(batch, time, 1, WIDTH),
            "lstm_h": torch.zeros(batch, time, 1, WIDTH),
            "lstm_c": torch.zeros(batch, time, 1, WIDTH),
        },
        batch_size=[batch, time],
    )


def _backward(module: nn.Module, out: torch.Tensor) -> None:
    for parameter in module.parameters():
        parameter.grad = None
    torch.autograd.backward(out)


def tensor_candidates(data: TensorDict, state: int) -> dict[str, Callable[[], None]]:
    """Make forward + backward calls on plain tensors."""
    obs = data["observation"].shape[-1]
    torch.manual_seed(0)
    filters = {"filter": BeliefFilter(obs, ACTION, state)}
    mean = data["recurrent", "mean"][:, 0]
    reset = data["is_init"].squeeze(-1)
    inputs = [data["previous_action"], data["observation"], data["observed"], reset]

    def run_filter(module: BeliefFilter) -> None:
        out = module(mean, None, *inputs)
        _backward(module, out.mean.square().mean() - out.log_likelihood.mean())

    def run_network(module: nn.Module) -> None:
        out, _ = module(data["observation"])
        _backward(module, out.square().mean())

    networks = {
        f"nn.GRU {WIDTH}, no resets": nn.GRU(obs, WIDTH, batch_first=True),
        f"nn.LSTM {WIDTH}, no resets": nn.LSTM(obs, WIDTH, batch_first=True),
    }
    out: dict[str, Callable[[], None]] = {}
    for name, module in filters.items():
        out[name] = lambda m=module: run_filter(m)
    for name, module in networks.items():
        out[name] = lambda m=module: run_network(m)
    return out


def module_candidates(data: TensorDict, state: int) -> dict[str, Callable[[], None]]:
    """Make forward + backward calls through keys, in recurrent mode."""
    obs = data["observation"].shape[-1]
    torch.manual_seed(0)
    ours = BeliefFilterModule(BeliefFilter(obs, ACTION, state))
    gru, lstm = {}, {}
    for backend in ("pad", "scan"):
        gru[backend] = GRUModule(
            input_size=obs,
            hidden_size=WIDTH,
            in_keys=["observation", "gru", "is_init"],
            out_keys=["features", ("next", "gru")],
            recurrent_backend=backend,
        )
    lstm["pad"] = LSTMModule(
        input_size=obs,
        hidden_size=WIDTH,
        in_keys=["observation", "lstm_h", "lstm_c", "is_init"],
        out_keys=["features", ("next", "lstm_h"), ("next", "lstm_c")],
        recurrent_backend="pad",
    )

    def run_ours() -> None:
        with set_recurrent_mode(True):
            out = ours(data.copy())
        ll = out["belief", "log_likelihood"]
        _backward(ours, out["features"].square().mean() - ll.mean())

    def run_theirs(module: nn.Module) -> None:
        with set_recurrent_mode(True):
            out = module(data.copy())
        _backward(module, out["features"].square().mean())

    out: dict[str, Callable[[], None]] = {"BeliefFilterModule": run_ours}
    for backend, module in gru.items():
        out[f"GRUModule {backend}"] = lambda m=module: run_theirs(m)
    out["LSTMModule pad"] = lambda: run_theirs(lstm["pad"])
    return out


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    args.add_argument(
        "--cases", choices=("targets", "grid", "all"), default="all", help="which sizes"
    )
    args = args.parse_args()
    run = start(args)
    rounds = args.rounds or (2 if args.quick else 9)
    chosen: dict[tuple[int, int, int, int], tuple[float, float] | None] = {}
    if args.quick:
        chosen[4, 2, 5, 3] = None
    else:
        if args.cases != "grid":
            chosen |= TARGETS
        if args.cases != "targets":
            chosen |= {case: aim for case, aim in GRID.items() if case not in chosen}
    results = []
    for case, target in chosen.items():
        time, batch, obs, state = case
        data = make_data(time, batch, obs, state)
        title = f"time {time} x batch {batch}, obs {obs}, state {state}"
        row = {"time": time, "batch": batch, "obs": obs, "state": state}
        sample = 0.0 if args.quick else 0.02
        levels = (
            ("tensors", tensor_candidates, f"nn.GRU {WIDTH}, no resets"),
            ("TensorDict", module_candidates, "GRUModule pad"),
        )
        for level, make, base in levels:
            times = interleave(
                make(data, state), rounds=rounds, sample_seconds=sample, clock=CLOCKS[args.clock]
            )
            report(f"{title}, {level}", times, base)
            row[level] = {name: times.median(name) for name in times.seconds}
            ours = next(iter(times.seconds))
            row[f"{level} ratio"] = times.ratio(ours, base)
            if target is not None and level == "TensorDict":
                print(verdict(f"{ours} / {base}", row[f"{level} ratio"], *target, quick=args.quick))
        results.append(row)
    print("\nAll ratios to GRU")
    for row in results:
        print(
            "time {time:4d} x batch {batch:3d}  obs {obs:3d}  state {state:3d}".format(**row),
            " tensors {:.2f}  TensorDict {:.2f}".format(
                row["tensors ratio"], row["TensorDict ratio"]
            ),
        )
    finish(args, run, results)


def report(title: str, times: Times, base: str) -> None:
    """Print one table: milliseconds, their spread, the ratio to GRU."""
    table(
        title,
        ("", "ms", "+-", f"/ {base}"),
        [
            (name, 1e3 * times.median(name), times.percent(name), times.ratio(name, base))
            for name in times.seconds
        ],
    )


if __name__ == "__main__":
    main()
