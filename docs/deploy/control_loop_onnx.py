"""Walk without torch: python docs/deploy/control_loop_onnx.py policy.onnx (ONNX Runtime, NumPy)."""

import sys

import gymnasium
import numpy as np
import onnxruntime

policy = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
kinds = {"tensor(float)": np.float32, "tensor(bool)": bool, "tensor(int64)": np.int64}
state = {x.name: np.zeros(x.shape, kinds[x.type]) for x in policy.get_inputs()}
state["observed"][:] = state["is_init"][:] = True

robot = gymnasium.make("Walker2d-v5")
rng = np.random.default_rng(0)
observation, _ = robot.reset(seed=0)
done, score, steps = False, 0.0, 0
while not done:
    observation[rng.random(len(observation)) < 0.3] = np.nan
    state["observation"] = observation[None].astype(np.float32)
    names = [x.name for x in policy.get_outputs()]
    found = dict(zip(names, policy.run(None, state), strict=True))
    state |= {"mean": found["next_mean"], "age": found["next_age"]}
    state["previous_action"] = found["chosen"]
    state["is_init"][:] = False
    observation, reward, terminated, truncated, _ = robot.step(found["action"][0])
    done, score, steps = terminated or truncated, score + float(reward), steps + 1
print(f"return {score:.0f} after {steps} steps")
