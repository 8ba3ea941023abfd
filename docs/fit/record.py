"""Record the log that docs/fit.md fits: ``python docs/fit/record.py docs/fit/swimmer.csv``.

Swimmer-v5 moved by smooth random torques; each sensor is noisy and off a third of the time, in
outages of mean length 8. A row a step: the readings, empty where there is none, and the action that
was taken then.
"""

from __future__ import annotations

import sys

import pandas as pd
import torch
from torchrl.envs import Compose, DoubleToFloat, TransformedEnv

from torchrl_drbpn import GymnasiumBatchEnv, ObservationNoise, SensorOutages, seed_env

SENSORS = ["tip", "joint1", "joint2", "vx", "vy", "tip_rate", "joint1_rate", "joint2_rate"]
EPISODES, STEPS, SMOOTH = 24, 150, 0.9

torch.manual_seed(0)
env = TransformedEnv(
    GymnasiumBatchEnv("Swimmer-v5", EPISODES),
    Compose(DoubleToFloat(), ObservationNoise(0.02), SensorOutages(eta=0.33, mean_length=8)),
)
seed_env(env, 0)
data, action, rows = env.reset(), torch.zeros(EPISODES, 2), []
for _ in range(STEPS):
    action = SMOOTH * action + (1 - SMOOTH**2) ** 0.5 * torch.randn(EPISODES, 2)
    data = env.step(data.set("action", (0.5 * action).clamp(-1, 1)))
    readings = data["observation"].where(data["observed"], torch.nan)
    rows.append(torch.cat([readings, data["action"]], -1))
    data = data["next"].clone()
table = pd.DataFrame(torch.stack(rows, 1).flatten(0, 1).numpy(), columns=[*SENSORS, "u1", "u2"])
table.insert(0, "run", [episode for episode in range(EPISODES) for _ in range(STEPS)])
table.to_csv(sys.argv[1], index=False, float_format="%.3f")
