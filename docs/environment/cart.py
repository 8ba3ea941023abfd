"""A robot of one's own, the example of environment.md: a cart whose two sensors fail with NaN."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box


class Cart(gymnasium.Env[np.ndarray, np.ndarray]):
    """Push a cart to the origin and keep it there.

    Args:
        failing: share of the readings that are NaN.
    """

    observation_space = Box(-np.inf, np.inf, (2,), np.float32)  # position, m; speed, m/s
    action_space = Box(-1, 1, (1,), np.float32)  # acceleration, m/s^2

    def __init__(self, failing: float = 0.0) -> None:
        self.failing, self.state = failing, np.zeros(2)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Put the cart somewhere, at rest."""
        super().reset(seed=seed, options=options)
        self.state = np.array([self.np_random.uniform(-1, 1), 0.0])
        return self._read(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Let a tenth of a second pass; earn minus the squared distance."""
        self.state = self.state + 0.1 * np.array([self.state[1], action[0]])
        return self._read(), -float(self.state[0] ** 2), False, False, {}

    def _read(self) -> np.ndarray:
        failed = self.np_random.random(2) < self.failing
        return np.where(failed, np.nan, self.state).astype(np.float32)


gymnasium.register("Cart-v0", Cart, max_episode_steps=100)
