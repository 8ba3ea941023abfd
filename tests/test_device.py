"""`device=`: where the recipe's networks and rollouts are, and that modules make tensors there.

"meta" stands for a device that isn't the CPU: it refuses to be mixed with it, as a GPU does.
"""

import pytest
import torch
from ppo_drbpn import assemble
from recipe_tools import SMOKE, assembled, command, make_config, refused, resume, run
from tensordict import TensorDict
from test_policy_step import first_step, make
from training import envs
from training.agent import device_named
from training.checkpoint import last_checkpoint, load_checkpoint
from training.ppo import to_sequences
from training.run_folder import load_config, resumed_config, write_config

from torchrl_drbpn import MaskedObservationNorm, PolicyStep


@pytest.mark.parametrize("name", ["tpu", "meta", "mps", "cuda:x", "cuda:-1", "gpu"])
def test_a_device_that_is_none_is_refused(name):
    with refused("`device` must be cpu, cuda"):
        device_named(name)


def test_a_gpu_that_is_not_here_ends_a_run_in_one_line_that_leaves_no_folder(tmp_path):
    missing = f"cuda:{torch.cuda.device_count()}"
    done = command("recipes/ppo_drbpn.py", "experiment=smoke", f"device={missing}", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: `device={missing}` is not here: torch finds")
    assert "Take device=cpu" in line
    assert not list(tmp_path.glob("runs/*"))


def test_the_collector_leaves_simulators_where_they_are(monkeypatch):
    training, _ = assembled(*SMOKE)
    made = []
    monkeypatch.setattr(envs, "Collector", lambda *args, **kwargs: made.append(kwargs))
    for device in ("cpu", "meta"):
        policy = training.agent.policy.to(device)
        envs.make_collector(training.env, policy, None, num_envs=4, steps_per_env=32)
    on_cpu, elsewhere = made
    places = {"policy_device", "storing_device", "env_device"}
    assert not places & on_cpu.keys()
    found = {name: torch.device(elsewhere[name]).type for name in places}
    assert found == {"policy_device": "meta", "storing_device": "meta", "env_device": "cpu"}


def test_a_resumed_run_may_move(smoke, tmp_path):
    config = load_config(smoke)
    assert config.device == "cpu"
    assert resumed_config(make_config("device=cuda"), ["device=cuda"], smoke).device == "cuda"
    del config.device  # of a run before there was the setting
    write_config(tmp_path, config)
    assert resumed_config(make_config(), [], tmp_path).get("device", "cpu") == "cpu"
    assert resumed_config(make_config("device=cuda"), ["device=cuda"], tmp_path).device == "cuda"


def test_sequences_stay_with_the_rollout():
    training, _ = assembled(*SMOKE)
    data = training.collector.rollout().to("meta")
    cut = to_sequences(data, training.algorithm.loss, 8)
    assert cut.shape == (16, 8)
    assert {value.device.type for value in cut.values(True, True)} == {"meta"}


def test_normalisation_and_the_robots_step_stay_with_their_input():
    norm = MaskedObservationNorm(3).to("meta")
    with torch.device("meta"):
        seen = torch.ones(2, 3, dtype=torch.bool)
        data = TensorDict({"observation": torch.zeros(2, 3), "observed": seen}, [2])
    assert norm(data)["normalized_observation"].device.type == "meta"
    for kind in ("free", "propagated"):
        belief, head = make(kind)
        inputs = [part.to("meta") for part in first_step(belief)]
        step = PolicyStep(belief, head).to("meta")
        assert {part.device.type for part in step(*inputs)} == {"meta"}


@pytest.mark.gpu
@pytest.mark.parametrize("overrides", [(), ("belief=gru",), ("belief=dvrl",), ("method=acktr",)])
def test_a_run_on_a_gpu_goes_on_on_the_cpu_and_back(overrides, tmp_path):
    folder = tmp_path / "run"
    assert run(folder, *SMOKE, "device=cuda", *overrides) == 0
    training = assemble(make_config(*SMOKE, "device=cuda", *overrides))
    assert all(p.is_cuda for p in training.agent.parameters())
    data = training.collector.rollout()
    assert data["observation"].is_cuda
    assert training.env.device in (None, torch.device("cpu"))
    assert resume(folder, "device=cpu", "total_frames=768") == 0
    assert resume(folder, "device=cuda", "total_frames=1024") == 0
    assert load_checkpoint(last_checkpoint(folder))["progress"]["frames"] == 1024
