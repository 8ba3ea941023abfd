"""What the epochs of an update are cut from; optim.recompute_advantages."""

import pytest
import torch
from ppo_drbpn import train_rollout
from recipe_tools import assembled, second_rollout
from torchrl.objectives.value import GAE
from training.ppo import add_advantages
from training.reward_scale import ReturnStatistics, scale_reward

SMOKE = ("experiment=smoke", "missingness=mcar", "missingness.eta=0.5")


def collected(*overrides):
    training, data = second_rollout(*SMOKE, *overrides)
    add_advantages(data, training.agent, training.gae)
    return training, data


def move_critic(training):
    with torch.no_grad():
        for parameter in training.agent.critic.parameters():
            parameter.add_(0.1)


# A particle filter draws anew at every pass: its beliefs are not repeated by a second step.
@pytest.mark.parametrize("belief", ["drbpn", "gru", "transformer", "fill"])
def test_the_parameters_that_collected_give_the_advantages_that_were_there(belief):
    training, data = collected(f"belief={belief}")
    before = data["advantage"].clone()
    add_advantages(data, training.agent, training.gae, recompute=True)
    torch.testing.assert_close(data["advantage"], before, rtol=1e-4, atol=1e-4)


def test_without_memory_it_is_gae_with_the_network_as_it_is_now():
    training, data = collected("belief=none")
    stale = data["advantage"].clone()
    move_critic(training)
    add_advantages(data, training.agent, training.gae, recompute=True)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=training.agent.critic, shifted=False)
    gae.set_keys(reward="scaled_reward")
    expected = data.clone()
    for part in (expected, expected["next"]):
        training.agent.belief(part)
    gae(expected)
    torch.testing.assert_close(data["advantage"], expected["advantage"], rtol=1e-5, atol=1e-5)
    assert not torch.allclose(data["advantage"], stale, atol=1e-3)


def losses(recompute, epochs):
    flag = f"optim.recompute_advantages={str(recompute).lower()}"
    training, config = assembled(*SMOKE, flag, f"optim.epochs={epochs}", "optim.lr=0.01")
    row, _ = train_rollout(training, config)
    return {key: row[key] for key in ("loss_critic", "loss_objective", "grad_norm")}


def test_the_first_epoch_is_that_of_the_plain_update_and_later_ones_differ():
    assert losses(True, 1) == losses(False, 1)
    assert losses(True, 2) != losses(False, 2)


def test_a_belief_without_memory_learns_from_single_steps_and_the_last_of_a_rollout_is_final():
    for belief, length in (("none", 1), ("gru", 8), ("drbpn", 8)):
        training, data = collected(f"belief={belief}", "optim.sequence_length=8")
        batch = next(training.algorithm.cut(data))
        assert batch.shape[1] == length
        final = batch["final"].reshape(data.shape)
        assert final[:, -1].all()
        assert not final[:, :-1].any()


GAMMA = 0.9


def make_rollouts(count=3, rows=2, time=15):
    generator = torch.Generator().manual_seed(0)
    shape = (count, rows, time, 1)
    reward = 2 + 3 * torch.randn(shape, generator=generator, dtype=torch.float64)
    return reward, torch.rand(shape, generator=generator) < 0.15


def test_the_scale_is_the_deviation_of_all_returns_up_to_the_end_of_the_rollout():
    rewards, dones = make_rollouts()
    statistics = ReturnStatistics.start(2)
    returns, current = [], [0.0, 0.0]
    for reward, done in zip(rewards, dones, strict=True):
        for t in range(reward.shape[1]):
            for row in range(2):
                current[row] = GAMMA * current[row] + reward[row, t].item()
                returns.append(current[row])
                if done[row, t]:
                    current[row] = 0.0
        deviation = torch.tensor(returns, dtype=torch.float64).std(correction=0)
        scaled, statistics = scale_reward(reward, done, statistics, gamma=GAMMA, eps=1e-12)
        torch.testing.assert_close(scaled, reward / deviation)
    assert statistics.n == rewards.numel()


def test_scaled_rewards_stay_within_the_clip():
    reward = torch.zeros(1, 400, 1)
    reward[0, 7] = -1.0
    done = torch.zeros_like(reward, dtype=torch.bool)
    scaled, _ = scale_reward(reward, done, ReturnStatistics.start(1), gamma=0.0, clip=2.0)
    assert scaled.amin() == -2.0
    assert scaled.dtype == reward.dtype
