"""An environment that starts the next episode by itself, as TorchRL's native auto-reset ones do."""

from suites import StaircaseEnv

__all__ = ["SelfResettingEnv"]


class SelfResettingEnv(StaircaseEnv):
    """A staircase whose step returns the first observation of the next episode where one ends."""

    def __init__(self, batch=3, horizon=3):
        super().__init__(batch=batch, horizon=horizon)
        self._torchrl_native_autoreset = True

    def _step(self, tensordict):
        data = super()._step(tensordict)
        ended = data["done"]
        self.time = self.time.masked_fill(ended.squeeze(-1), 0)
        return data.set("observation", self._observe()["observation"])
