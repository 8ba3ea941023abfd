"""Walk without TorchRL: python docs/deploy/control_loop.py policy.pt2 (torch and a robot)."""

import sys

import gymnasium
import numpy as np
import torch

policy = torch._inductor.aoti_load_package(sys.argv[1])
# format=export instead: policy = torch.export.load(sys.argv[1]).module()

robot = gymnasium.make("Walker2d-v5")  # in the place of yours: reads sensors, takes actions
sensors, motors = robot.observation_space.shape[0], robot.action_space.shape[0]
rng = np.random.default_rng(0)

observation, _ = robot.reset(seed=0)
everything = torch.ones(1, sensors, dtype=torch.bool)  # or what is known to have arrived
previous_action = torch.zeros(1, motors)
is_init = torch.ones(1, 1, dtype=torch.bool)
mean, age = torch.zeros(1, sensors), torch.zeros(1, 1, dtype=torch.int64)
done, score, steps = False, 0.0, 0
while not done:
    observation[rng.random(sensors) < 0.3] = np.nan  # what failed to arrive
    x = torch.tensor(observation, dtype=torch.float32)[None]
    action, mean, age, previous_action, rejected = policy(
        x, everything, previous_action, is_init, mean, age
    )
    is_init = torch.zeros_like(is_init)
    observation, reward, terminated, truncated, _ = robot.step(action[0].numpy())
    done, score, steps = terminated or truncated, score + float(reward), steps + 1
print(f"return {score:.0f} after {steps} steps")
