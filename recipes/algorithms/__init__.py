"""How the agent learns from a rollout.

An algorithm is a new file here and a new entry in conf/algo. Collection, normalisation, advantages,
logging, checkpoints and evaluation are the same for all of them.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Protocol

from tensordict import TensorDictBase
from training.agent import Agent
from training.config import Settings
from training.errors import UserError


class Algorithm(Protocol):
    """What training asks of an algorithm."""

    def update(self, data: TensorDictBase, remaining: float) -> dict[str, float]:
        """Change the agent's parameters after one rollout.

        Args:
            data: rollout of batch size ``(environments, time)`` with ``state_value``,
                ``advantage`` and ``value_target``.
            remaining: share of the run still to come when the rollout began, in [0, 1].

        Returns:
            Numbers for metrics.csv by column, ``lr`` among them.
        """

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint needs beside the agent: tensors, numbers, containers of them.

        Returns:
            Entries of the checkpoint, by name.
        """

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up a saved state.

        Args:
            state: a checkpoint that holds the entries of :meth:`state_dict`, among others.
        """


def build_algorithm(settings: Settings, agent: Agent) -> Algorithm:
    """Call the builder that a conf/algo entry names.

    Args:
        settings: of the run; ``settings.algo`` is the entry: ``_target_`` (module and function),
            ``name``, and what else the builder takes.
        agent: whose parameters the algorithm changes.

    Returns:
        The algorithm.

    Raises:
        UserError: if there is no such builder, or its settings are refused.
    """
    path, _, function = str(settings.algo.get("_target_", "")).rpartition(".")
    try:
        builder = getattr(importlib.import_module(path), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(
            f"`algo._target_` must name a builder such as algorithms.ppo.build, "
            f"got {settings.algo.get('_target_')!r}."
        ) from error
    own = {k: v for k, v in settings.algo.items() if k not in ("_target_", "name")}
    try:
        return builder(settings, agent, **own)
    except (TypeError, ValueError) as error:
        raise UserError(f"`algo={settings.algo.get('name')}`: {error}") from error
