"""What does one PPO update cost, and what one decision?

Update: a rollout is collected; then one of its minibatches is passed through the belief alone, the
loss, the loss and its backward pass, and the whole gradient step (gradient norm and Adam with it),
for the defaults, for experiment=paper and for the same agent without a belief.

Decision: from what arrived to the action, for one robot and for 64: the TensorDict policy, the same
on plain tensors (PolicyStep), exported by torch.export, and compiled ahead of time by AOTInductor
(needs a C++ compiler; left out by --quick). All give the same action.
"""

import logging
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from interleaved import measure, recipe, show, start
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import PolicyStep

POLICY, WHOLE = "TensorDict policy", "whole step"


def update_parts(training: Any) -> tuple[dict[str, Callable[[], Any]], Any]:
    """Make the calls of one update, each with all that comes before it, and its minibatch."""
    from ppo_drbpn import collect
    from training.ppo import add_advantages, minibatches

    agent, algorithm = training.agent, training.algorithm
    agent.norm.update(collect(training))
    data = collect(training)
    add_advantages(data, agent, training.gae)
    sequences = next(algorithm.cut(data))
    batch = next(minibatches(sequences, algorithm.steps.minibatches, algorithm.generator))
    for group in algorithm.steps.optimizer.param_groups:
        group["lr"] = 0.0

    def through_belief() -> None:
        with set_recurrent_mode(True):
            agent.belief(batch.copy())

    def backward() -> None:
        algorithm.steps.optimizer.zero_grad()
        losses = [v for key, v in algorithm.loss(batch).items() if key.startswith("loss")]
        torch.autograd.backward(sum(losses))

    calls = {
        "belief forward": through_belief,
        "loss forward": lambda: algorithm.loss(batch),
        "loss forward and backward": backward,
        WHOLE: lambda: algorithm.step(batch),
    }
    return calls, batch


def decisions(training: Any, rows: int, folder: Path | None) -> dict[str, Callable[[], Any]]:
    """Make the calls of one decision, checked against each other; AOTInductor with a folder."""
    agent = training.agent.eval()
    step = PolicyStep(agent.belief, agent.actor.module[0].module, norm=agent.norm)
    keys = ["observation", *agent.belief.in_keys[1:]]
    row = training.collector.rollout()[:1, 8:9].reshape(-1).expand(rows)
    inputs = tuple(row.get(key).clone() for key in keys)
    source = TensorDict(dict(zip(keys, inputs, strict=True)), batch_size=[rows])
    exported = torch.export.export(step, inputs)
    plain: dict[str, Callable[..., Any]] = {"PolicyStep": step, "exported": exported.module()}
    if folder is not None:
        logging.getLogger("torch._inductor").setLevel(logging.ERROR)
        path = str(folder / f"policy_{rows}.pt2")
        package = torch._inductor.aoti_compile_and_package(
            exported,
            package_path=path,
            inductor_configs={"freezing": True, "max_autotune": True},
        )
        plain["AOTInductor"] = torch._inductor.aoti_load_package(package)
    expected = agent.policy(source.copy()).get("action")
    for call in plain.values():
        torch.testing.assert_close(call(*inputs)[0], expected, rtol=1e-4, atol=1e-5)
    calls = {name: lambda call=call: call(*inputs) for name, call in plain.items()}
    return {POLICY: lambda: agent.policy(source.copy())} | calls


def main() -> None:
    """Run from the command line."""
    args = start(__doc__ or "", env="walker2d")
    warnings.filterwarnings("ignore", category=FutureWarning)
    common = [f"env={args.env}", "env.version=v5"]
    if args.quick:
        common += ["collector.num_envs=2", "collector.steps_per_env=16", "optim.minibatches=2"]
        common += ["optim.compile=false"]
    for name in ("defaults", "experiment=paper", "belief=none"):
        training, _ = recipe(*([name] * (name != "defaults")), *common)
        calls, batch = update_parts(training)
        title = f"update, {name}, minibatch of {batch.shape[0]} x {batch.shape[1]} frames"
        show(title, measure(calls, args, calls=5), WHOLE, args)
    training, _ = recipe(*common)
    with (
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
        tempfile.TemporaryDirectory() as folder,
    ):
        for rows in (1, 64):
            calls = decisions(training, rows, None if args.quick else Path(folder))
            show(f"a decision, {rows} robots", measure(calls, args, calls=200), POLICY, args)


if __name__ == "__main__":
    main()
