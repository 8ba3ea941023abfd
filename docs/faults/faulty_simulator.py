"""The code of docs/faults.md: thousands of simulators on one device, and sensors that fail."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TransformedEnv

from torchrl_drbpn import (
    ObservationDelay,
    ObservationMultiRate,
    ObservationNoise,
    PreviousAction,
    SensorDrift,
    SensorOutages,
    StuckSensors,
    seed_env,
)

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


class Carts(EnvBase):
    """Carts on rails, all in one tensor: position, velocity, and the force that is measured."""

    def __init__(self, carts: int, device: str) -> None:
        super().__init__(batch_size=[carts], device=device)
        self.observation_spec = Composite(observation=Unbounded((carts, 3)), shape=[carts])
        self.action_spec = Unbounded((carts, 1))
        self.reward_spec = Unbounded((carts, 1))
        done = Categorical(2, shape=(carts, 1), dtype=torch.bool)
        self.done_spec = Composite(done=done, terminated=done.clone(), shape=[carts])
        self.state = torch.zeros(carts, 3, device=device)

    def _observe(self) -> TensorDict:
        lost = self.state[:, :1].abs() > 3
        out = {"observation": self.state.clone(), "done": lost, "terminated": lost.clone()}
        return TensorDict(out, self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        rows = None if tensordict is None else tensordict.get("_reset", None)
        fresh = 2 * torch.rand_like(self.state) - 1
        self.state = fresh if rows is None else torch.where(rows, fresh, self.state)
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        position, velocity, _ = self.state.split(1, -1)
        force = tensordict["action"]
        velocity = velocity + 0.05 * force
        self.state = torch.cat([position + 0.05 * velocity, velocity, force], -1)
        return self._observe().set("reward", -position.square())

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


POSITION, VELOCITY, FORCE = range(3)

env = TransformedEnv(
    Carts(4096, DEVICE),
    Compose(
        PreviousAction(),
        # wrong readings that arrive: their masks stay True
        SensorDrift(0.01, groups=[[VELOCITY]]),
        ObservationNoise(0.02),
        StuckSensors(probability=0.01, mean_length=20, groups=[[FORCE]]),
        # readings that do not arrive, or late: masked
        ObservationMultiRate([1, 4], phase=[0, 2], groups=[[VELOCITY], [POSITION]]),
        ObservationDelay(0, max_delay=2, groups=[[POSITION, VELOCITY]]),
        SensorOutages(eta=0.2, mean_length=10, groups=[[POSITION, VELOCITY], [FORCE]]),
        InitTracker(),
    ),
)
seed_env(env, 0)

data = env.rollout(50, break_when_any_done=False)
observation, observed = data["observation"], data["observed"]
print(f"{data.numel()} steps of {env.batch_size[0]} simulators on {data.device or DEVICE}")
for sensor, name in enumerate(("position", "velocity", "force")):
    print(f"{name} arrives in {observed[..., sensor].float().mean():.2f} of the steps")
print(f"the force sensor is stuck in {(data['stuck_steps'] > 0).float().mean():.2f} of the steps")
