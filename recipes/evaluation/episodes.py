"""Whole episodes of a policy, each with random numbers of its own.

Episodes run in batches of `BLOCK` simulators, however few are asked for: what an episode draws
(its start, its gaps and noise, its actions, the particles of its belief) depends on its number and
the seed alone, to the bit, so that more episodes only add to fewer.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pandas as pd
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from training.agent import Agent

from torchrl_drbpn import seed_env

BLOCK = 32
_KINDS = {"sampled": ExplorationType.RANDOM, "mean": ExplorationType.DETERMINISTIC}
# Of features. Observations are normalised: a belief a million deviations off has diverged.
_FARTHEST = 1e6

Watch = Callable[[slice, TensorDictBase, Tensor], None]


def evaluate(
    policy: TensorDictModuleBase,
    make_env: Callable[[int], TransformedEnv],
    *,
    episodes: int,
    mode: str,
    seed: int,
    stop: Callable[[], bool] = lambda: False,
) -> pd.DataFrame | None:
    """Run episodes, see :func:`run_episodes`, one row each; None if they were given up.

    ``log_likelihood``: nats per observed entry, normalised units, NaN without a model or where the
    belief ``diverged``, see `StoppingPolicy`.
    """
    names = ("return", "length", "entries", "arrived", "nats", "diverged")
    sums = torch.zeros(len(names), episodes, dtype=torch.float64)

    def add(rows: slice, data: TensorDictBase, running: Tensor) -> None:
        mask, one = data.get("observed"), torch.ones(len(running), dtype=torch.float64)
        nats, diverged = data.get(("belief", "log_likelihood"), None), data.get("diverged", None)
        step = [data.get(("next", "reward")).squeeze(-1), one, mask.shape[-1] * one, mask.sum(-1)]
        step.append(one * torch.nan if nats is None else nats.reshape(-1))
        step.append(0 * one if diverged is None else diverged.squeeze(-1))
        for total, value in zip(sums, step, strict=True):
            total[rows] += running * value

    how: Any = {"episodes": episodes, "mode": mode, "seed": seed, "watch": add, "stop": stop}
    if not run_episodes(policy, make_env, **how):
        return None
    table = pd.DataFrame(dict(zip(names, sums.numpy(), strict=True)))
    diverged = table.diverged > 0
    likelihood = table.nats / table.arrived.clip(lower=1)
    return table[["return"]].assign(
        length=table.length.astype(int),
        missing_ratio=1 - table.arrived / table.entries,
        log_likelihood=likelihood.where(~diverged),
        diverged=diverged.astype(int),
    )


def over_episodes(episodes: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Sum up rows of :func:`evaluate` by some of their columns, over all steps and entries."""
    arrived = episodes.length * (1 - episodes.missing_ratio)
    nats = arrived * episodes.get("log_likelihood", np.nan)
    diverged = episodes.get("diverged", 0.0)
    table = episodes.assign(arrived=arrived, nats=nats, diverged=diverged)
    rows = table.groupby(list(by), sort=False, as_index=False).agg(
        episodes=("return", "size"),
        return_mean=("return", "mean"),
        return_std=("return", "std"),
        length_mean=("length", "mean"),
        steps=("length", "sum"),
        arrived=("arrived", "sum"),
        nats=("nats", lambda values: values.sum(skipna=False)),
        diverged=("diverged", "mean"),
    )
    return rows.assign(
        missing_ratio=1 - rows.arrived / rows.steps,
        # The weights are counts over the number of components: one entry of many is below 1.
        log_likelihood=rows.nats / rows.arrived.clip(lower=1e-12),
    )


def run_episodes(
    policy: Callable[[TensorDictBase], TensorDictBase],
    make_env: Callable[[int], TransformedEnv],
    *,
    episodes: int,
    mode: str,
    seed: int,
    watch: Watch,
    stop: Callable[[], bool] = lambda: False,
) -> bool:
    """Run episodes to their ends; False if ``stop``, asked at every step, gave them up.

    ``make_env`` builds the environment of the block of a number, batch size ``(BLOCK,)``. ``watch``
    is called after every step with the episodes of the block, the stepped tensordict of these, and
    whether each was still running before the step. The global generator is left as it was found.
    """
    gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else []  # type: ignore[no-untyped-call]
    with torch.random.fork_rng(gpus), torch.no_grad(), set_exploration_type(_KINDS[mode]):
        for block, first in enumerate(range(0, episodes, BLOCK)):
            rows = slice(first, min(first + BLOCK, episodes))
            count = rows.stop - first
            own = int(np.random.SeedSequence((seed, block)).generate_state(1)[0])
            with closing(make_env(block)) as env:
                torch.manual_seed(own)
                seed_env(env, own)
                running = (torch.arange(BLOCK) < count).unsqueeze(-1)
                root = _leave_standing(env.reset(), running)
                while running.any():
                    if stop():
                        return False
                    # An episode that is over costs no simulation and changes no other row.
                    data = env.step(policy(root).set("_step", running))
                    watch(rows, data[:count], running[:count, 0])
                    running = running & ~data.get(("next", "done"))
                    root = _leave_standing(env.step_mdp(data), running)
    return True


def _leave_standing(root: TensorDictBase, running: Tensor) -> TensorDictBase:
    """Let the beliefs of episodes that are over begin anew, in place.

    The policy sees the last observation of these again and again: a belief that went on with that
    could leave the range of its numbers.
    """
    if not running.all():
        root.set("is_init", root.get("is_init") | ~running)
        carried = root.get("recurrent", None)
        if carried is not None:
            root.set("recurrent", carried.apply(lambda value: _only_rows(running, value)))
    return root


def _only_rows(rows: Tensor, value: Tensor) -> Tensor:
    """Put zeros into the rows where ``rows``, of shape ``(batch, 1)``, is False."""
    return torch.where(rows.reshape(-1, *(1,) * (value.ndim - 1)), value, torch.zeros_like(value))


class StoppingPolicy(TensorDictModuleBase):
    """Act as ``agent.policy``; where the belief has ``diverged``, with zero actions to the end.

    Without its sensors a learned transition runs open loop and need not be stable.
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.norm, self.belief, self.actor = agent.norm, agent.belief, agent.actor
        self.in_keys = list(agent.policy.in_keys)
        self.out_keys = [*agent.policy.out_keys, "diverged"]
        self._stopped = torch.zeros(())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write belief, action and ``diverged``, bool of shape ``(batch, 1)``."""
        checking = [m for m in self.belief.modules() if getattr(m, "validate", False)]
        for part in checking:  # what is not finite is written, in the place of an error
            part.validate = False
        try:
            tensordict = self.belief(self.norm(tensordict))
        finally:
            for part in checking:
                part.validate = True
        written = {key: tensordict.get(key) for key in self.belief.out_keys}
        numbers = {key: value for key, value in written.items() if value.is_floating_point()}
        near = tensordict.get("features").abs().amax(-1, keepdim=True) < _FARTHEST
        for value in numbers.values():
            near = near & value.isfinite().reshape(len(value), -1).all(-1, keepdim=True)
        stopped = ~near | (self._stopped.bool() & ~tensordict.get("is_init"))
        self._stopped = stopped
        # The row starts from zeros again, so that what reads it need not bear NaN.
        for key, value in numbers.items() if stopped.any() else ():
            tensordict.set(key, _only_rows(~stopped, value))
        tensordict = self.actor(tensordict)
        tensordict.set("action", _only_rows(~stopped, tensordict.get("action")))
        return tensordict.set("diverged", stopped)
