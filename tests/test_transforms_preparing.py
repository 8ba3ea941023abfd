"""PreviousAction and FillLastObserved: what happened before, in this episode."""

from functools import partial

import pytest
import torch
from suites import StaircaseEnv
from tensordict import TensorDict
from torchrl.data import Bounded, Composite
from torchrl.envs import ActionScaling, Compose, GymEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_drbpn.transforms import FillLastObserved, ObservationMissingness, PreviousAction


class SelfResettingEnv(StaircaseEnv):
    """A staircase whose step returns the first observation of the next episode where one ends."""

    def __init__(self, batch=3, horizon=3):
        super().__init__(batch=batch, horizon=horizon)
        self._torchrl_native_autoreset = True  # as TorchRL's auto-resetting environments say it

    def _step(self, tensordict):
        data = super()._step(tensordict)
        ended = data["done"]
        self.time = self.time.masked_fill(ended.squeeze(-1), 0)
        return data.set("observation", self._observe()["observation"])


def expected_shift(data):
    """Actions moved by one step along the last batch dimension, zero where an episode begins."""
    shifted = torch.zeros_like(data["action"])
    going_on = ~data["next", "done"][..., :-1, :]
    shifted[..., 1:, :] = data["action"][..., :-1, :] * going_on
    return shifted


def placed(where, simulator, add):
    """Let `add` append to a simulator, to each of two in a batch, or to the batch."""
    if where == "inside":
        return SerialEnv(2, lambda: add(simulator()))
    return add(SerialEnv(2, simulator) if where == "outside" else simulator())


def staircase(where, horizon):
    return SelfResettingEnv if where == "self-resetting" else partial(StaircaseEnv, horizon=horizon)


EVERYWHERE = pytest.mark.parametrize("where", ["inside", "outside", "alone", "self-resetting"])


@EVERYWHERE
def test_it_is_the_action_of_the_step_before_and_zero_after_every_reset(where):
    env = placed(where, staircase(where, 2), lambda env: TransformedEnv(env, PreviousAction()))
    data = env.rollout(11, break_when_any_done=False)
    done = data["next", "done"]
    assert done.any(-2).all()
    assert not torch.equal(done, done[..., :1, :, :].expand_as(done))
    assert torch.equal(data["previous_action"], expected_shift(data))
    if where != "self-resetting":
        assert torch.equal(data["next", "previous_action"], data["action"])


class KeepingEnv(StaircaseEnv):
    """Takes actions in [-1, 1] and keeps what it received."""

    def __init__(self):
        super().__init__()
        self.action_spec = Composite(
            action=Bounded(-1.0, 1.0, shape=(3, 2), dtype=torch.float32), shape=(3,)
        )

    def _step(self, tensordict):
        self.received = tensordict["action"].clone()
        return super()._step(tensordict)


class Halve(Transform):
    """An action transform: the environment receives half of what the agent chose."""

    def __init__(self):
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return action / 2


def test_it_is_the_chosen_action_not_the_one_that_the_simulator_received():
    env = TransformedEnv(KeepingEnv(), Compose(Halve(), PreviousAction()))
    data = env.rand_step(env.reset())
    assert torch.equal(env.base_env.received, data["action"] / 2)
    assert torch.equal(data["next", "previous_action"], data["action"])
    assert not [key for key in data.keys(True, True) if "_chosen" in str(key)]
    # transforms later in the chain have been at it
    env = TransformedEnv(KeepingEnv(), Compose(PreviousAction(), Halve()))
    data = env.rand_step(env.reset())
    assert torch.equal(data["next", "previous_action"], data["action"] / 2)
    # TorchRL's own scaling; another key
    scaled = Compose(ActionScaling(), PreviousAction(out_keys="last_action"))
    env = TransformedEnv(GymEnv("Pendulum-v1"), scaled)
    data = env.rand_step(env.reset())
    assert torch.equal(data["next", "last_action"], data["action"])


@pytest.mark.parametrize("categorical", [False, True])
def test_a_discrete_action_keeps_dtype_and_shape(categorical):
    env = TransformedEnv(
        GymEnv("CartPole-v1", categorical_action_encoding=categorical), PreviousAction()
    )
    check_env_specs(env)
    data = env.rollout(5)
    assert data["previous_action"].dtype == data["action"].dtype
    assert torch.equal(data["previous_action"][1:], data["action"][:-1])
    assert (data["previous_action"][0] == 0).all()


@pytest.mark.parametrize("where", ["alone", "inside", "outside"])
def test_an_index_action_may_be_written_as_one_hot_and_is_zero_at_a_start(where):
    simulator = partial(GymEnv, "CartPole-v1", categorical_action_encoding=True)
    env = placed(where, simulator, lambda env: TransformedEnv(env, PreviousAction(one_hot=True)))
    check_env_specs(env)
    data = env.rollout(150, break_when_any_done=False)
    following = data["next", "previous_action"]
    assert torch.equal(following, torch.nn.functional.one_hot(data["action"], 2).float())
    assert (data["previous_action"][..., 0, :] == 0).all()
    over = data["next", "done"][..., :-1, 0]
    assert over.any()
    assert (data["previous_action"][..., 1:, :][over] == 0).all()


def test_one_hot_needs_an_index():
    for env in (GymEnv("CartPole-v1"), StaircaseEnv()):
        with pytest.raises(ValueError, match="`one_hot` needs an index action"):
            TransformedEnv(env, PreviousAction(one_hot=True)).reset()


def test_an_absent_action_is_named():
    env = TransformedEnv(StaircaseEnv(), PreviousAction("torque"))
    with pytest.raises(KeyError, match=r"PreviousAction.*torque"):
        env.reset()
    with pytest.raises(KeyError, match="`PreviousAction` reads 'action', which is not among"):
        PreviousAction()._step(TensorDict(), TensorDict())


def filled(env, **kwargs):
    """Append missingness that keeps the complete observation, and what fills the gaps."""
    gaps = ObservationMissingness("mcar", 0.5, seed=0, complete_key="complete_observation")
    return TransformedEnv(env, Compose(gaps, FillLastObserved(**kwargs)))


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
@EVERYWHERE
def test_it_equals_filling_step_by_step(where, fill_value):
    env = placed(where, staircase(where, 4), partial(filled, fill_value=fill_value))
    data = env.rollout(17, break_when_any_done=False)
    assert data["next", "done"].sum() > 6
    assert (data["observed"].float().mean() - 0.5).abs() < 0.2
    # an environment that resets itself overwrites the last observation: the roots alone are read
    data = data.reshape(-1, 17)
    assert torch.equal(data["observation"], filled_by_hand(data, fill_value))


def test_with_other_out_keys_the_observation_stays_as_it_was():
    data = filled(StaircaseEnv(), out_keys="filled", state_keys="memory").rollout(
        8, break_when_any_done=False
    )
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
