"""RunningReturnScale: the reward divided by the running spread of the discounted return.

Specified here, against discounted returns computed by a loop over the rewards of each environment:
the scale at every step, with partial resets, in any arrangement of environments; that the raw
reward stays beside the scaled one where it is asked to; that specs, RewardSum and GAE agree with
it; frozen and saved statistics; learning in several processes is refused. On top, the duties of
every transform.
"""

import pytest
import torch
from contracts import StaircaseEnv, TransformContract, gym_env, saved
from self_resetting import SelfResettingEnv
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import Compose, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.objectives.value import GAE

from torchrl_drbpn.functional.statistics import masked_moments, variance
from torchrl_drbpn.transforms import RunningReturnScale

GAMMA = 0.9


class RewardEnv(StaircaseEnv):
    """Rewards from a normal law, in float64."""

    def __init__(self, batch=3, horizon=3, seed=0):
        super().__init__(batch=batch, horizon=horizon)
        self.reward_spec = Unbounded(shape=(batch, 1), dtype=torch.float64)
        self.generator = torch.Generator().manual_seed(seed)

    def _step(self, tensordict):
        reward = torch.randn(*self.batch_size, 1, generator=self.generator, dtype=torch.float64)
        return super()._step(tensordict).set("reward", 3 * reward + 1)


def scaled(**options):
    """Return the transform as the recipes use it."""
    return RunningReturnScale(GAMMA, ["reward"], ["scaled_reward"], **options)


def returns_by_hand(reward, done):
    """Discounted returns of every row, from zero after each end of an episode."""
    result = torch.zeros_like(reward)
    for b in range(reward.shape[0]):
        total = 0.0
        for t in range(reward.shape[1]):
            total = GAMMA * total + reward[b, t].item()
            result[b, t] = total
            if done[b, t]:
                total = 0.0
    return result


def check_against_hand(data, eps=1e-8, clip=10.0):
    """Assert the scale at every step from rewards and ends alone; data is [rows, time]."""
    reward, done = data["next", "reward"], data["next", "done"]
    returns = returns_by_hand(reward, done)
    torch.testing.assert_close(data["next", "discounted_return"], returns)
    for t in range(data.shape[1]):
        past = returns[:, : t + 1].double()
        if past.numel() > 1:
            scale = (past.var(correction=0) + eps).sqrt()
            expected = (reward[:, t] / scale).clamp(-clip, clip)
            torch.testing.assert_close(
                data["next", "scaled_reward"][:, t], expected.to(reward.dtype)
            )


# ----------------------------------------------------------------------------------------- duties
class Base(TransformContract):
    keeps_float64 = ("scaled_reward", "discounted_return")

    def check_output(self, before, after):
        if "reward" in after and "scaled_reward" in after:
            assert torch.equal(after["scaled_reward"].sign(), after["reward"].sign())
            assert (after["scaled_reward"].abs() <= 10).all()
        if "observation" in before:
            assert torch.equal(after["observation"], before["observation"])
            assert torch.equal(after["reward"], before["reward"])


def learned(**options):
    """Return the transform with the statistics of a few rewards."""
    transform = scaled(**options)
    reward = torch.randn(50, 1, generator=torch.Generator().manual_seed(0))
    root = TensorDict(discounted_return=torch.zeros(50, 1), batch_size=50)
    transform._step(root, TensorDict(reward=reward, batch_size=50))
    return transform


class TestLearningScaleContract(Base):
    refused_in_workers = "RunningReturnScale cannot learn inside a SerialEnv or ParallelEnv"

    def make_transform(self):
        return scaled()


class TestFrozenScaleContract(Base):
    offline = "works"

    def make_transform(self):
        return learned().freeze()


# ----------------------------------------------------------------------------------------- values
@pytest.mark.parametrize("where", ["batched", "outside"])
def test_it_is_the_reward_over_the_spread_of_independently_computed_returns(where):
    if where == "batched":
        env = TransformedEnv(RewardEnv(), scaled())
    else:
        env = TransformedEnv(
            SerialEnv(2, [lambda: RewardEnv(1, 2, seed=1), lambda: RewardEnv(1, 5, seed=2)]),
            scaled(),
        )
    data = env.rollout(20, break_when_any_done=False)
    done = data["next", "done"]
    assert done.any()
    # partial: the rows end at different times
    assert not torch.equal(done, done[:1].expand_as(done))
    check_against_hand(data.reshape(-1, 20))


def test_a_step_in_a_worker_reads_the_return_that_it_is_given():
    env = SerialEnv(2, lambda: TransformedEnv(RewardEnv(), learned().freeze()))
    assert "discounted_return" in env.full_state_spec.keys(True, True)
    root = env.reset()
    root["discounted_return"] = torch.full_like(root["discounted_return"], 100.0)
    after = env.rand_step(root)["next"]
    torch.testing.assert_close(after["discounted_return"], 100 * GAMMA + after["reward"])


def test_a_collector_carries_the_returns_from_batch_to_batch():
    collector = Collector(
        TransformedEnv(RewardEnv(horizon=7), scaled()), frames_per_batch=12, total_frames=60
    )
    data = torch.cat(list(collector), -1)
    assert data.shape == (3, 20)
    check_against_hand(data)


def test_returns_start_from_zero_where_an_environment_resets_itself():
    env = TransformedEnv(SelfResettingEnv(), scaled())
    data = env.rollout(11, break_when_any_done=False)
    assert data["next", "done"].any()
    returns = returns_by_hand(data["next", "reward"], data["next", "done"])
    # the last return of an episode is overwritten with NaN: look at the roots
    expected = torch.zeros_like(returns)
    expected[:, 1:] = returns[:, :-1] * ~data["next", "done"][:, :-1]
    torch.testing.assert_close(data["discounted_return"], expected)


def test_the_statistics_are_those_of_all_returns():
    env = TransformedEnv(RewardEnv(), scaled())
    data = env.rollout(15, break_when_any_done=False)
    returns = returns_by_hand(data["next", "reward"], data["next", "done"]).reshape(-1, 1)
    expected = (variance(masked_moments(returns)) + 1e-8).sqrt()
    torch.testing.assert_close(env.transform.scale, expected, rtol=1e-11, atol=0.0)
    assert env.transform.moments[0].count == 45


def test_discount_zero_divides_by_the_spread_of_the_reward():
    env = TransformedEnv(RewardEnv(), RunningReturnScale(0.0, out_keys="scaled_reward"))
    reward = env.rollout(9, break_when_any_done=False)["next", "reward"]
    torch.testing.assert_close(
        env.transform.scale.squeeze(), reward.var(correction=0).add(1e-8).sqrt()
    )


def test_scaling_the_reward_does_not_change_what_is_scaled():
    torch.manual_seed(0)
    reward = torch.randn(50, 4, 1, dtype=torch.float64)
    results = []
    for factor in (1.0, 1000.0):
        transform, root = scaled(), TensorDict(batch_size=4)
        rows = []
        for r in reward * factor:
            root = transform._step(root, TensorDict(reward=r, batch_size=4))
            rows.append(root["scaled_reward"])
        results.append(torch.stack(rows))
    torch.testing.assert_close(results[0], results[1], rtol=1e-6, atol=1e-9)


def test_scaled_rewards_stay_within_the_clip():
    transform, root = scaled(clip=0.5), TensorDict(batch_size=64)
    reward = torch.randn(64, 1, generator=torch.Generator().manual_seed(0))
    after = transform._step(root, TensorDict(reward=reward, batch_size=64))
    assert after["scaled_reward"].abs().max() == 0.5


def test_the_first_reward_of_a_single_environment_keeps_its_scale():
    after = scaled()._step(TensorDict(), TensorDict(reward=torch.tensor([4.0])))
    torch.testing.assert_close(after["scaled_reward"], torch.tensor([4.0]))


def test_rows_that_did_not_step_are_not_learned_from():
    transform = scaled()
    root = TensorDict(_step=torch.tensor([True, False, True]), batch_size=3)
    step = TensorDict(reward=torch.tensor([[1.0], [99.0], [3.0]]), batch_size=3)
    transform._step(root, step)
    assert transform.moments[0].count == 2
    assert transform.moments[0].mean == 2.0


def test_several_rewards_have_statistics_of_their_own():
    transform = RunningReturnScale(GAMMA, ["reward", ("arm", "reward")])
    step = TensorDict(
        {"reward": torch.tensor([[1.0], [3.0]]), ("arm", "reward"): torch.tensor([[0.0], [8.0]])}, 2
    )
    transform._step(TensorDict(batch_size=2), step)
    torch.testing.assert_close(step["reward"], torch.tensor([[1.0], [3.0]]))
    torch.testing.assert_close(step["arm", "reward"], torch.tensor([[0.0], [2.0]]))
    assert torch.equal(step["arm", "discounted_return"], torch.tensor([[0.0], [8.0]]))


# ----------------------------------------------------------------------------- in TorchRL's hands
def test_the_raw_reward_stays_beside_the_scaled_one_for_reward_sum():
    env = gym_env().append_transform(Compose(scaled(), RewardSum(in_keys=["reward"])))
    check_env_specs(env)
    data = env.rollout(10)
    reward = data["next", "reward"]
    assert reward.max() == 1
    assert torch.equal(data["next", "episode_reward"], reward.cumsum(0))
    assert not torch.equal(data["next", "scaled_reward"], reward)
    assert env.reward_keys == ["reward", "scaled_reward"]
    assert "scaled_reward" not in data


def test_in_place_it_replaces_the_reward():
    env = TransformedEnv(RewardEnv(), RunningReturnScale(GAMMA))
    check_env_specs(env)
    raw = TransformedEnv(RewardEnv(), Compose()).rollout(4)["next", "reward"]
    env = TransformedEnv(RewardEnv(), RunningReturnScale(GAMMA))
    data = env.rollout(4)
    torch.testing.assert_close(data["next", "reward"][:, -1], raw[:, -1] / env.transform.scale)


def test_gae_takes_the_scaled_reward_from_collected_data():
    env = TransformedEnv(RewardEnv(), scaled())
    data = env.rollout(10, break_when_any_done=False)
    value = TensorDictModule(nn.Linear(5, 1), ["observation"], ["state_value"])
    gae = GAE(gamma=GAMMA, lmbda=0.9, value_network=value)
    gae.set_keys(reward="scaled_reward")
    received = gae(data.clone())["advantage"]
    plain = data.clone()
    plain["next", "reward"] = plain["next", "scaled_reward"].float()
    expected = GAE(gamma=GAMMA, lmbda=0.9, value_network=value)(plain)["advantage"]
    torch.testing.assert_close(received.float(), expected)


# ------------------------------------------------------------------------------- frozen and saved
def test_a_frozen_instance_never_changes_and_goes_on_scaling():
    env = TransformedEnv(RewardEnv(), scaled())
    env.rollout(10, break_when_any_done=False)
    transform = env.transform.freeze()
    scale = transform.scale
    data = env.rollout(10, break_when_any_done=False)
    assert torch.equal(transform.scale, scale)
    torch.testing.assert_close(data["next", "scaled_reward"], data["next", "reward"] / scale)
    transform.unfreeze()
    env.rollout(10)
    assert not torch.equal(transform.scale, scale)


def test_a_frozen_copy_shares_nothing():
    transform = scaled()
    step = TensorDict(reward=torch.tensor([[1.0], [3.0]]), batch_size=2)
    transform._step(TensorDict(batch_size=2), step.clone())
    twin = transform.frozen_copy()
    scale = twin.scale
    transform._step(TensorDict(batch_size=2), 50 * step)
    assert torch.equal(twin.scale, scale)
    assert not torch.equal(transform.scale, scale)


def test_the_state_survives_a_file_read_without_running_code():
    env = TransformedEnv(RewardEnv(), scaled())
    env.rollout(10)
    fresh = scaled()
    fresh.load_state_dict(saved(env.transform.state_dict()))
    assert torch.equal(fresh.scale, env.transform.scale)
    assert torch.equal(fresh.moments[0].count, env.transform.moments[0].count)


def test_stored_rewards_are_scaled_where_they_are():
    transform = scaled().freeze()
    transform.load_state_dict(_trained_state())
    data = TensorDict({"next": {"reward": torch.tensor([[4.0]])}}, [1])
    received = transform(data)["next", "scaled_reward"]
    torch.testing.assert_close(received, torch.tensor([[4.0]]))
    assert "scaled_reward" not in data


def _trained_state():
    transform = scaled()
    step = TensorDict(reward=torch.tensor([[1.0], [3.0]]), batch_size=2)
    transform._step(TensorDict(batch_size=2), step)
    return transform.state_dict()


# --------------------------------------------------------------------------------------- refusals
def test_learning_in_the_worker_of_a_collector_is_refused():
    env = TransformedEnv(RewardEnv(), learned())
    # what a multi-process collector builds in each of its workers
    options = {"frames_per_batch": 3, "total_frames": 3, "worker_idx": 0}
    with pytest.raises(RuntimeError, match=r"RunningReturnScale.*worker processes of a multi-proc"):
        Collector(env, **options)
    env.transform.freeze()
    assert len(list(Collector(env, **options))) == 1


def test_a_reward_that_is_not_finite_is_refused_and_not_learned():
    transform = scaled()
    transform.load_state_dict(_trained_state())
    scale = transform.scale
    step = TensorDict(reward=torch.tensor([[1.0], [float("nan")]]), batch_size=2)
    with pytest.raises(ValueError, match="`reward` holds NaN or an infinity"):
        transform._step(TensorDict(batch_size=2), step)
    assert torch.equal(transform.scale, scale)


class CountEnv(StaircaseEnv):
    """Integer rewards."""

    def __init__(self):
        super().__init__()
        self.reward_spec = Composite(
            points=Categorical(5, shape=(3, 1), dtype=torch.int64), shape=(3,)
        )


def test_a_reward_of_another_name_or_kind_is_named():
    with pytest.raises(KeyError, match="reads 'reward', which is not among the rewards"):
        _ = TransformedEnv(CountEnv(), scaled()).observation_spec
    env = TransformedEnv(CountEnv(), RunningReturnScale(GAMMA, "points"))
    with pytest.raises(ValueError, match="`points` must be floating point"):
        _ = env.observation_spec


@pytest.mark.parametrize(
    ("arguments", "options", "match"),
    [
        ((1.5,), {}, "`gamma` must be in"),
        ((-0.1,), {}, "`gamma` must be in"),
        ((float("nan"),), {}, "`gamma` must be in"),
        ((0.9,), {"clip": -1.0}, "`clip` must be positive"),
        ((0.9,), {"eps": 0.0}, "`eps` must be positive"),
        ((0.9, "reward", ["a", "b"]), {}, "`out_keys` of RunningReturnScale"),
    ],
)
def test_impossible_settings_are_refused(arguments, options, match):
    with pytest.raises(ValueError, match=match):
        RunningReturnScale(*arguments, **options)
