"""How long does one decision take?

From the observation that arrived to the action, for one robot and for 64: the TensorDict policy of
the recipe, the same on plain tensors (PolicyStep), PolicyStep exported by torch.export, and
compiled ahead of time by AOTInductor (needs a C++ compiler; left out by --quick). Microseconds a
call; all give the same action.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from recipe import assemble, settings_of
from tensordict import TensorDict
from timing import CLOCKS, finish, interleave, parser, start, table, verdict
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_drbpn import PolicyStep

POLICY = "TensorDict policy"
COMPILED = "AOTInductor package"
# Microseconds for one robot: to be reached, aimed at.
TARGETS = ((POLICY, 1000, 1000), (COMPILED, 100, 40))


def compile_ahead(step: PolicyStep, inputs: tuple[torch.Tensor, ...], folder: Path) -> Any:
    """Export and compile for one batch size; returns the loaded package."""
    logging.getLogger("torch._inductor").setLevel(logging.ERROR)
    exported = torch.export.export(step, inputs)
    path = torch._inductor.aoti_compile_and_package(
        exported, package_path=str(folder / f"policy_{len(inputs[0])}.pt2")
    )
    return torch._inductor.aoti_load_package(path)


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    args.add_argument("--env", default="walker2d", help="an entry of conf/env")
    args.add_argument("--no-compile", action="store_true", help="leave AOTInductor out")
    args = args.parse_args()
    run = start(args)
    rounds = args.rounds or (2 if args.quick else 15)
    compiling = not (args.quick or args.no_compile)
    if compiling and shutil.which("g++") is None and shutil.which("clang++") is None:
        print("AOTInductor left out: no C++ compiler (g++ or clang++) in PATH.")
        compiling = False
    warnings.filterwarnings("ignore", category=FutureWarning)
    settings = settings_of(
        f"env={args.env}",
        "collector.num_envs=1",
        "collector.steps_per_env=16",
        "optim.minibatches=1",
    )
    training = assemble(settings)
    agent = training.agent.eval()
    step = PolicyStep(agent.belief, agent.actor.module[0].module)
    data = training.collector.rollout()
    training.collector.shutdown()
    keys = agent.belief.in_keys
    results = {}
    with (
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
        tempfile.TemporaryDirectory() as folder,
    ):
        for batch in (1, 64):
            row = data[:, 8:9].reshape(-1).expand(batch)
            inputs = tuple(row.get(key).clone() for key in keys)
            source = TensorDict(dict(zip(keys, inputs, strict=True)), batch_size=[batch])
            candidates: dict[str, Callable[[], Any]] = {
                POLICY: lambda source=source: agent.policy(source.copy()),
                "PolicyStep": lambda inputs=inputs: step(*inputs),
            }
            exported = torch.export.export(step, inputs).module()
            candidates["PolicyStep, exported"] = lambda inputs=inputs, f=exported: f(*inputs)
            if compiling:
                package = compile_ahead(step, inputs, Path(folder))
                candidates[COMPILED] = lambda inputs=inputs, f=package: f(*inputs)
            expected = candidates[POLICY]().get("action")
            for name, call in candidates.items():
                out = call()
                action = out.get("action") if name == POLICY else out[0]
                torch.testing.assert_close(action, expected, rtol=1e-4, atol=1e-5)
            times = interleave(
                candidates,
                rounds=rounds,
                sample_seconds=0.0 if args.quick else 0.03,
                clock=CLOCKS[args.clock],
            )
            microseconds = {name: 1e6 * times.median(name) for name in times.seconds}
            table(
                f"{settings.env.env_id}, batch {batch}",
                ("", "us", "+-", f"/ {POLICY}"),
                [
                    (name, value, times.percent(name), times.ratio(name, POLICY))
                    for name, value in microseconds.items()
                ],
            )
            if batch == 1:
                print(verdict(f"{POLICY}, us", microseconds[POLICY], 1000, 1000, quick=args.quick))
                if compiling:
                    print(
                        verdict(
                            f"{COMPILED}, us", microseconds[COMPILED], 100, 40, quick=args.quick
                        )
                    )
            results[f"batch {batch}"] = microseconds
    finish(args, run, results)


if __name__ == "__main__":
    main()
