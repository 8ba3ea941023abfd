"""Where does the time of one PPO update go?

One rollout is collected; then updates on one of its minibatches are timed part by part, for the
recipe's defaults, for experiment=paper, and for the same agent without a belief (belief=none).
Parts: filter (both passes of the belief module), heads and loss, the backward pass down to the
features, the backward pass through the filter, gradient norm and optimiser.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import torch
from recipe import (
    PPO,
    Training,
    add_advantages,
    assemble,
    minibatches,
    settings_of,
    to_sequences,
)
from tensordict import TensorDictBase
from timing import CLOCKS, finish, interleave, parser, start, table

from torchrl_drbpn.functional import FilterOutput, FollowedOutput

PARTS = (
    "filter",
    "heads and loss",
    "backward, heads and loss",
    "backward, filter",
    "optimiser",
)


class Update:
    """One gradient step, with a clock at the borders of its parts."""

    def __init__(
        self,
        training: Training,
        ppo: PPO,
        batch: TensorDictBase,
        max_norm: float,
        clock: Callable[[], float],
    ) -> None:
        self.ppo, self.batch, self.max_norm, self.clock = ppo, batch, max_norm, clock
        self.parameters = list(training.agent.parameters())
        self.rows: list[dict[str, float]] = []
        self._in_filter = 0.0
        self._features_done: float | None = None
        # The loss calls the filter itself where it can; a hook on the module would change that.
        belief = getattr(training.agent.belief, "filter", training.agent.belief)
        belief.register_forward_pre_hook(self._enter)
        belief.register_forward_hook(self._leave)

    def _enter(self, *_: Any) -> None:
        self._entered = self.clock()

    def _leave(self, _module: Any, _inputs: Any, out: Any) -> None:
        self._in_filter += self.clock() - self._entered
        plain = isinstance(out, (FilterOutput, FollowedOutput))
        features = out.mean if plain else out.get("features")
        whole = features.shape[:2] == self.batch.shape  # not the pass over the last observations
        if whole and features.requires_grad:
            # The engine computes this gradient when it has passed loss and heads.
            features.register_hook(self._mark)

    def _mark(self, _grad: torch.Tensor) -> None:
        self._features_done = self.clock()

    def __call__(self) -> None:
        """Take the step and note its times."""
        loss, optimizer = self.ppo.loss, self.ppo.optimizer
        self._in_filter, self._features_done = 0.0, None
        begin = self.clock()
        out = loss(self.batch)
        total = sum(value for key, value in out.items() if key.startswith("loss"))
        assert isinstance(total, torch.Tensor)
        forward = self.clock()
        optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(total)
        backward = self.clock()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.max_norm)
        optimizer.step()
        end = self.clock()
        middle = backward if self._features_done is None else self._features_done
        values = (
            self._in_filter,
            forward - begin - self._in_filter,
            middle - forward,
            backward - middle,
            end - backward,
        )
        self.rows.append(dict(zip(PARTS, values, strict=True)))

    def median(self, part: str) -> float:
        """Return the median milliseconds of a part."""
        return 1e3 * statistics.median(row[part] for row in self.rows)


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    args.add_argument("--env", default="walker2d", help="an entry of conf/env")
    args = args.parse_args()
    run = start(args)
    rounds = args.rounds or (2 if args.quick else 60)
    size = ["collector.num_envs=2", "collector.steps_per_env=16"] if args.quick else []
    common = [f"env={args.env}", *size]
    few = ["optim.minibatches=2"] if args.quick else []
    cases = {
        "defaults": [*common, *few],
        "experiment=paper": ["experiment=paper", "env.version=v5", *common, *few],
        "belief=none": ["belief=none", *common, *few],
    }
    updates = {}
    titles = {}
    for name, overrides in cases.items():
        settings = settings_of(*overrides)
        training = assemble(settings)
        data = training.collector.rollout()
        add_advantages(data, training.agent, training.gae)
        ppo = training.algorithm
        assert isinstance(ppo, PPO)
        sequences = to_sequences(data, ppo.loss, settings.optim.sequence_length)
        batch = next(minibatches(sequences, settings.optim.minibatches, ppo.generator))
        updates[name] = Update(
            training, ppo, batch, settings.optim.max_grad_norm, CLOCKS[args.clock]
        )
        titles[name] = (
            f"{name} ({batch.shape[0]} x {batch.shape[1]} = {batch.numel()} frames a minibatch)"
        )
        training.collector.shutdown()
    times = interleave(updates, rounds=rounds, warmup=3, clock=CLOCKS[args.clock])
    results = {}
    for name, update in updates.items():
        total = 1e3 * times.median(name)
        rows = [(part, update.median(part), 100 * update.median(part) / total) for part in PARTS]
        table(titles[name], ("", "ms", "%"), [*rows, ("whole update", total, 100.0)])
        results[name] = {part: value for part, value, _ in rows} | {"whole": total}
    print()
    for name in ("defaults", "experiment=paper"):
        print(f"{name} / belief=none: {times.ratio(name, 'belief=none'):.2f}")
    finish(args, run, results)


if __name__ == "__main__":
    main()
