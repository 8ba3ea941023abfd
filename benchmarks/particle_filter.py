"""How fast is the particle filter, forward and backward, beside the belief filter and a GRU?

Through keys and over [batch, time], 30 % of the entries missing, 2 % of the steps an episode start:
ParticleFilterModule at the sizes of `belief=dvrl` (10 particles, memory 128, latent 256) and with
other numbers of particles, BeliefFilterModule and GRUModule (64) beside them in one run.

Ratios are times over GRUModule's.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from timing import CLOCKS, finish, interleave, parser, start, table
from torchrl.modules import GRUModule, set_recurrent_mode

from torchrl_drbpn import BeliefFilter, BeliefFilterModule, ParticleFilter, ParticleFilterModule

WIDTH, ACTION = 64, 6
# (time, batch, obs)
CASES = ((16, 16, 17), (16, 64, 17), (16, 16, 105))
BASE = f"GRUModule {WIDTH}"


def make_data(time: int, batch: int, obs: int) -> TensorDict:
    """Make what an environment writes, from a seed of its own."""
    generator = torch.Generator().manual_seed(0)
    observed = torch.rand(batch, time, obs, generator=generator) > 0.3
    return TensorDict(
        {
            "observation": torch.randn(batch, time, obs, generator=generator) * observed,
            "observed": observed,
            "previous_action": torch.randn(batch, time, ACTION, generator=generator).clamp(-1, 1),
            "is_init": torch.rand(batch, time, 1, generator=generator) < 0.02,
        },
        batch_size=[batch, time],
    )


def make_modules(
    obs: int, particles: tuple[int, ...], *, quick: bool
) -> dict[str, TensorDictModuleBase]:
    """Make the candidates."""
    torch.manual_seed(0)
    sizes = {"hidden_dim": 8, "latent_dim": 4} if quick else {}
    out: dict[str, TensorDictModuleBase] = {
        f"ParticleFilterModule, {count} particles": ParticleFilterModule(
            ParticleFilter(obs, ACTION, num_particles=count, **sizes)
        )
        for count in particles
    }
    out["BeliefFilterModule"] = BeliefFilterModule(BeliefFilter(obs, ACTION))
    out[BASE] = GRUModule(
        input_size=obs,
        hidden_size=WIDTH,
        in_keys=["observation", "recurrent_state", "is_init"],
        out_keys=["features", ("next", "recurrent_state")],
    )
    return out


def candidate(module: TensorDictModuleBase, data: TensorDict) -> Callable[[], None]:
    """Make a call: over time, then the gradient of features and likelihood."""
    # A primer's zeros, as a collector stores them.
    state = {
        key: spec.expand(*data.shape, *spec.shape).zero()
        for key, spec in module.make_tensordict_primer().primers.items(True, True)
    }
    data = data.copy().update(state)

    def run() -> None:
        for parameter in module.parameters():
            parameter.grad = None
        with set_recurrent_mode(True):
            out = module(data.copy())
        total = out["features"].square().mean()
        log_likelihood = out.get(("belief", "log_likelihood"), None)
        if log_likelihood is not None:
            total = total - log_likelihood.mean()
        torch.autograd.backward(total)

    return run


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "").parse_args()
    run = start(args)
    rounds = args.rounds or (2 if args.quick else 7)
    cases = ((4, 2, 5),) if args.quick else CASES
    particles = (1, 3) if args.quick else (1, 10, 30)
    results = []
    for time, batch, obs in cases:
        data = make_data(time, batch, obs)
        modules = make_modules(obs, particles, quick=args.quick)
        calls = {name: candidate(module, data) for name, module in modules.items()}
        times = interleave(
            calls,
            rounds=rounds,
            warmup=1,
            sample_seconds=0.0 if args.quick else 0.1,
            clock=CLOCKS[args.clock],
        )
        table(
            f"time {time} x batch {batch}, obs {obs}: forward + backward",
            ("", "ms", "+-", f"/ {BASE}"),
            [
                (name, 1e3 * times.median(name), times.percent(name), times.ratio(name, BASE))
                for name in calls
            ],
        )
        row: dict[str, object] = {"time": time, "batch": batch, "obs": obs}
        row["seconds"] = {name: times.median(name) for name in calls}
        row["ratio"] = {name: times.ratio(name, BASE) for name in calls}
        results.append(row)
    finish(args, run, results)


if __name__ == "__main__":
    main()
