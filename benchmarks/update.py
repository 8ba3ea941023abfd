"""What does one PPO update cost, and what one decision?

Update: a rollout is collected; then one of its minibatches is passed through the belief alone, the
loss, the loss and its backward pass, and the whole gradient step (gradient norm and Adam with it),
for the defaults, for experiment=paper and for the same agent without a belief.

Decision: from what arrived to the action, for one robot and for 64: the TensorDict policy, the same
on plain tensors (PolicyStep), exported by torch.export, and compiled ahead of time by AOTInductor
(needs a C++ compiler; left out by --quick). All give the same action.
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
from interleaved import measure, recipe, show, start
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import PolicyStep

POLICY, WHOLE = "TensorDict policy", "whole step"


def update_parts(training: Any, settings: Any) -> tuple[dict[str, Callable[[], Any]], Any]:
    """Make the calls of one update, each with all that comes before it, and its minibatch."""
    from ppo_drbpn import collect
    from training.ppo import add_advantages, minibatches, to_sequences

    loss, belief = training.algorithm.loss, training.agent.belief
    data = collect(training)
    add_advantages(data, training.agent, training.gae)
    sequences = to_sequences(data, loss, settings.optim.sequence_length)
    generator = torch.Generator().manual_seed(0)
    batch = next(minibatches(sequences, settings.optim.minibatches, generator))
    parameters = [p for p in training.agent.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=0.0, fused=True)

    def through_belief() -> None:
        with set_recurrent_mode(True):
            belief(batch.copy())

    def backward() -> None:
        optimizer.zero_grad()
        losses = [value for key, value in loss(batch).items() if key.startswith("loss")]
        torch.autograd.backward(sum(losses))

    def step() -> None:
        backward()
        torch.nn.utils.clip_grad_norm_(parameters, settings.optim.max_grad_norm)
        optimizer.step()

    calls = {
        "belief forward": through_belief,
        "loss forward": lambda: loss(batch),
        "loss forward and backward": backward,
        WHOLE: step,
    }
    return calls, batch


def decisions(training: Any, rows: int, folder: Path | None) -> dict[str, Callable[[], Any]]:
    """Make the calls of one decision, checked against each other; AOTInductor with a folder."""
    agent = training.agent.eval()
    step = PolicyStep(agent.belief, agent.actor.module[0].module)
    keys = agent.belief.in_keys
    row = training.collector.rollout()[:1, 8:9].reshape(-1).expand(rows)
    inputs = tuple(row.get(key).clone() for key in keys)
    source = TensorDict(dict(zip(keys, inputs, strict=True)), batch_size=[rows])
    exported = torch.export.export(step, inputs)
    plain: dict[str, Callable[..., Any]] = {"PolicyStep": step, "exported": exported.module()}
    if folder is not None:
        logging.getLogger("torch._inductor").setLevel(logging.ERROR)
        path = str(folder / f"policy_{rows}.pt2")
        package = torch._inductor.aoti_compile_and_package(exported, package_path=path)
        plain["AOTInductor"] = torch._inductor.aoti_load_package(package)
    policy = TensorDictSequential(agent.belief, agent.actor)  # of normalised observations
    expected = policy(source.copy()).get("action")
    for call in plain.values():
        torch.testing.assert_close(call(*inputs)[0], expected, rtol=1e-4, atol=1e-5)
    calls = {name: lambda call=call: call(*inputs) for name, call in plain.items()}
    return {POLICY: lambda: policy(source.copy())} | calls


def main() -> None:
    """Run from the command line."""
    args = start(__doc__ or "", env="walker2d")
    warnings.filterwarnings("ignore", category=FutureWarning)
    common = [f"env={args.env}", "env.version=v5"]
    if args.quick:
        common += ["collector.num_envs=2", "collector.steps_per_env=16", "optim.minibatches=2"]
    for name in ("defaults", "experiment=paper", "belief=none"):
        training, settings = recipe(*([name] * (name != "defaults")), *common)
        calls, batch = update_parts(training, settings)
        title = f"update, {name}, minibatch of {batch.shape[0]} x {batch.shape[1]} frames"
        show(title, measure(calls, args, calls=5), WHOLE, args)
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        print("AOTInductor left out: no C++ compiler (g++ or clang++) in PATH.")
    training, _ = recipe(*common)
    with (
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
        tempfile.TemporaryDirectory() as folder,
    ):
        for rows in (1, 64):
            ahead = Path(folder) if compiler is not None and not args.quick else None
            calls = decisions(training, rows, ahead)
            show(f"a decision, {rows} robots", measure(calls, args, calls=200), POLICY, args)


if __name__ == "__main__":
    main()
