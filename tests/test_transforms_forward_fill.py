"""FillLastObserved: a missing entry takes the last value of its component in this episode."""

import pytest
import torch
from contracts import StaircaseEnv
from self_resetting import SelfResettingEnv
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, SerialEnv, TransformedEnv

from torchrl_drbpn.transforms import FillLastObserved, ObservationMissingness


def masked(env, eta=0.5, seed=0):
    """Append missingness that keeps the complete observation beside what is left of it."""
    return env.append_transform(
        ObservationMissingness("mcar", eta, seed=seed, complete_key="complete_observation")
    )


def filled_by_hand(data, fill_value):
    """Fill the last values row by row and step by step, from the complete observations."""
    rows, steps, obs = data["complete_observation"].shape
    filled = torch.empty(rows, steps, obs)
    last = torch.full((rows, obs), fill_value)
    for t in range(steps):
        for b in range(rows):
            if t == 0 or data["next", "done"][b, t - 1]:
                last[b] = fill_value
            for i in range(obs):
                if data["observed"][b, t, i]:
                    last[b, i] = data["complete_observation"][b, t, i]
        filled[:, t] = last
    return filled


@pytest.mark.parametrize("fill_value", [0.0, -7.0])
@pytest.mark.parametrize("where", ["inside", "outside", "batched"])
def test_it_equals_filling_step_by_step(where, fill_value):
    def simulator():
        return TransformedEnv(StaircaseEnv(horizon=4), Compose())

    def filler():
        return FillLastObserved(fill_value=fill_value)

    if where == "batched":
        env = masked(simulator()).append_transform(filler())
    elif where == "inside":
        env = SerialEnv(2, lambda: masked(simulator()).append_transform(filler()))
    else:
        env = masked(TransformedEnv(SerialEnv(2, simulator), Compose())).append_transform(filler())
    data = env.rollout(17, break_when_any_done=False)
    assert data["next", "done"].sum() > 6
    assert (data["observed"].float().mean() - 0.5).abs() < 0.2
    data = data.reshape(-1, 17)
    assert torch.equal(data["observation"], filled_by_hand(data, fill_value))


def test_a_step_in_a_worker_reads_the_last_values_that_it_is_given():
    def worker():
        return masked(TransformedEnv(StaircaseEnv(), Compose())).append_transform(
            FillLastObserved()
        )

    env = SerialEnv(2, worker)
    assert "last_observation" in env.full_state_spec.keys(True, True)
    root = env.reset()
    root["last_observation"] = torch.full_like(root["last_observation"], -50.0)
    after = env.rand_step(root)["next"]
    assert not after["observed"].all()
    assert (after["observation"][~after["observed"]] == -50).all()


def test_a_collector_carries_the_last_values_from_batch_to_batch():
    env = masked(TransformedEnv(StaircaseEnv(horizon=5), Compose()))
    env = env.append_transform(FillLastObserved())
    collector = Collector(env, frames_per_batch=12, total_frames=48)
    data = torch.cat(list(collector), -1)
    assert data.shape == (3, 16)
    assert torch.equal(data["observation"], filled_by_hand(data, 0.0))


def test_an_environment_that_resets_itself_starts_from_the_fill_value():
    env = masked(TransformedEnv(SelfResettingEnv(), Compose()))
    env = env.append_transform(FillLastObserved(fill_value=-7.0))
    data = env.rollout(17, break_when_any_done=False)
    assert data["next", "done"].sum() > 6
    # such an environment overwrites the last observation of an episode: look at the roots alone
    assert torch.equal(data["observation"], filled_by_hand(data, -7.0))


def test_with_other_out_keys_the_observation_stays_as_it_was():
    env = masked(TransformedEnv(StaircaseEnv(), Compose()))
    env = env.append_transform(FillLastObserved(out_keys="filled", state_keys="memory"))
    data = env.rollout(8, break_when_any_done=False)
    assert (data["observation"][~data["observed"]] == 0).all()
    assert torch.equal(data["filled"], filled_by_hand(data, 0.0))
    assert torch.equal(data["memory"], data["filled"])


def test_several_observations_have_last_values_of_their_own():
    fill = FillLastObserved(["joints", ("arm", "touch")], ["joints_seen", ("arm", "seen")])
    seen = torch.tensor([True, False])
    last = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    root = TensorDict({"last_joints": last[0], ("arm", "last_touch"): last[1]})
    step = TensorDict({"joints": torch.tensor([8.0, 0.0]), "joints_seen": seen})
    step["arm"] = TensorDict({"touch": torch.tensor([0.0, 9.0]), "seen": ~seen})
    after = fill._step(root, step)
    assert torch.equal(after["joints"], torch.tensor([8.0, 2.0]))
    assert torch.equal(after["arm", "touch"], torch.tensor([3.0, 9.0]))


def test_without_a_mask_it_says_who_writes_one():
    env = TransformedEnv(StaircaseEnv(), FillLastObserved())
    for use in (env.reset, lambda: env.observation_spec):
        with pytest.raises(KeyError, match=r"reads the mask 'observed'.*ObservationMissingness"):
            use()
