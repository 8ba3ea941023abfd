"""How fast is the filter, forward and backward, against the recurrent modules one could take?

Three questions over [batch, time], 30 % of the entries missing, 2 % of the steps an episode start:

- BeliefFilter with a constant and a propagated covariance, their PyTorch forms and
  BeliefFilterModule against GRUModule and LSTMModule of width
  64, at the sizes that have a bar (`--cases targets`);
- the same over a grid of sizes (`--cases grid`);
- how time and memory grow with one size at a time (`--cases growth`); memory is the rise of the
  peak resident size in a process of its own.

Ratios are times over GRUModule's; under 1 the filter is the faster one.
"""

import itertools
import multiprocessing
import resource
from collections.abc import Callable
from typing import Any

import torch
from interleaved import measure, show, start
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import GRUModule, LSTMModule, set_recurrent_mode

from torchrl_drbpn import BeliefFilter, BeliefFilterModule
from torchrl_drbpn.functional import filter_sequence, native_status

WIDTH, ACTION = 64, 6
# (obs, state) and the ratio to GRUModule that has to be reached, at time 16 x batch 16.
BARS = {(17, 17): 0.40, (17, 64): 0.55, (105, 32): 1.2}
PROPAGATED_BAR = 2.5  # of a propagated covariance over the constant one, in the same form
PYTORCH_BAR = 2.5  # of the PyTorch form at obs 17, state 17
BASE = {"time": 16, "batch": 16, "obs": 17, "state": 17}
GROWTH = {
    "time": (16, 64, 256, 1024),
    "batch": (16, 64, 256, 1024),
    "obs": (11, 17, 45, 105, 348),
    "state": (8, 16, 32, 64, 128),
}
Calls = dict[str, Callable[[], None]]


def make_data(time: int, batch: int, obs: int, state: int) -> TensorDict:
    """Make inputs of every module, from a seed of their own."""
    g = torch.Generator().manual_seed(0)
    observed = torch.rand(batch, time, obs, generator=g) > 0.3
    is_init = torch.rand(batch, time, 1, generator=g) < 0.02
    return TensorDict(
        {
            "observation": torch.randn(batch, time, obs, generator=g) * observed,
            "observed": observed,
            "previous_action": torch.rand(batch, time, ACTION, generator=g) * 2 - 1,
            "is_init": is_init,
            ("recurrent", "mean"): 0.1 * torch.randn(batch, time, state, generator=g),
            # An age that agrees with is_init, as the collector stores it.
            ("recurrent", "age"): (~is_init).long(),
            **{key: torch.zeros(batch, time, 1, WIDTH) for key in ("gru", "lstm_h", "lstm_c")},
        },
        batch_size=[batch, time],
    )


def backward(module: nn.Module, loss: Tensor) -> None:
    """Differentiate by the parameters, whose gradients are made anew."""
    for parameter in module.parameters():
        parameter.grad = None
    loss.backward()


def tensor_calls(data: TensorDict, state: int) -> Calls:
    """Make forward + backward calls of the filter on plain tensors."""
    torch.manual_seed(0)
    obs = data["observation"].shape[-1]
    kinds = ("constant", "propagated")
    modules = {kind: BeliefFilter(obs, ACTION, state, covariance=kind) for kind in kinds}
    cov = torch.eye(state).repeat(len(data), 1, 1)
    inputs = [data[key] for key in ("previous_action", "observation", "observed")]
    inputs = [data["recurrent", "mean"][:, 0], *inputs, data["is_init"].squeeze(-1)]

    def run(kind: str, pytorch: bool) -> None:
        module = modules[kind]
        if pytorch:
            out = filter_sequence(module.state_space(), *inputs, cov=cov, form="pytorch")
        else:
            out = module(inputs[0], cov, *inputs[1:])
        backward(module, out.mean.square().mean() - out.log_likelihood.mean())

    return {
        "BeliefFilter": lambda: run("constant", False),
        "PyTorch form": lambda: run("constant", True),
        "propagated": lambda: run("propagated", False),
        "propagated, PyTorch": lambda: run("propagated", True),
    }


def module_calls(data: TensorDict, state: int) -> Calls:
    """Make forward + backward calls through keys, in recurrent mode."""
    obs = data["observation"].shape[-1]
    torch.manual_seed(0)
    common: dict[str, Any] = {"input_size": obs, "hidden_size": WIDTH, "recurrent_backend": "pad"}
    keys = ["lstm_h", "lstm_c"]
    modules = {
        "BeliefFilterModule": BeliefFilterModule(BeliefFilter(obs, ACTION, state)),
        "GRUModule": GRUModule(
            in_keys=["observation", "gru", "is_init"],
            out_keys=["features", ("next", "gru")],
            **common,
        ),
        "LSTMModule": LSTMModule(
            in_keys=["observation", *keys, "is_init"],
            out_keys=["features", *(("next", key) for key in keys)],
            **common,
        ),
    }

    def run(module: nn.Module) -> None:
        with set_recurrent_mode(True):
            out = module(data.copy())
        loss = out["features"].square().mean()
        ll = out.get(("belief", "log_likelihood"), None)
        backward(module, loss if ll is None else loss - ll.mean())

    return {name: lambda module=module: run(module) for name, module in modules.items()}


def peak_rise(sizes: dict[str, int], pipe: Any) -> None:
    """Send by how many MiB one pass raises the peak resident size of this process."""
    torch.set_num_threads(1)
    call = tensor_calls(make_data(**sizes), sizes["state"])["BeliefFilter"]
    tensor_calls(make_data(**(BASE | {"time": 4})), BASE["state"])["BeliefFilter"]()  # libraries
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    call()
    pipe.send((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)


def memory(sizes: dict[str, int]) -> float:
    """Measure :func:`peak_rise` in a process of its own."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=peak_rise, args=(sizes, theirs))
    process.start()
    rise = float(ours.recv())
    process.join()
    return rise


def main() -> None:
    """Run from the command line."""
    args = start(__doc__ or "", cases=["targets", "grid", "growth"])
    print(f"# native form: {native_status() or 'runs'}")
    cases: dict[tuple[int, int, int], float | None] = {}
    if "targets" in args.cases:
        cases |= {(16, *sizes): bar for sizes, bar in BARS.items()}
    if "grid" in args.cases:
        grid = itertools.product((16, 64, 256), (11, 17, 105), (16, 32, 64))
        cases |= {case: None for case in grid if case not in cases}
    for (time, obs, state), bar in {(4, 5, 3): None}.items() if args.quick else cases.items():
        data = make_data(time, 16, obs, state)
        calls = tensor_calls(data, state) | module_calls(data, state)
        bars = [bar, PYTORCH_BAR if (bar, state) == (0.40, 17) else None, None, None]
        title = f"time {time} x batch 16, obs {obs}, state {state}"
        seconds = measure(calls, args, calls=3)
        show(title, seconds, "GRUModule", args, bar=[*bars, *[None] * 3])
        for form, over in (("BeliefFilter", "propagated"), ("PyTorch form", "propagated, PyTorch")):
            pair = seconds[[form, over]]
            show(f"{title}: propagated", pair, form, args, bar=[None, PROPAGATED_BAR])
    growth = {"state": (8, 16)} if args.quick else GROWTH
    for name, values in growth.items() if "growth" in args.cases else ():
        sizes = {v: BASE | {name: v} for v in values}
        made = {v: tensor_calls(make_data(**s), s["state"]) for v, s in sizes.items()}
        seconds = measure({f"{name} {v}": c["BeliefFilter"] for v, c in made.items()}, args)
        rise = [memory(s) for s in sizes.values()]
        show(f"growth with {name}", seconds, f"{name} {values[0]}", args, peak_MiB=rise)


if __name__ == "__main__":
    main()
