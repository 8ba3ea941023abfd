"""Rewards are divided by the running deviation of the discounted return.

Specified here: the statistics against a plain loop over all steps of all rollouts; that returns go
on over the end of a rollout and begin anew where an episode ended; one scale a rollout, the mean
not subtracted, a clip; a state of tensors.
"""

from __future__ import annotations

import pytest
import torch
from contract_environments import saved

import recipe_tools  # noqa: F401  # isort: skip (the recipes become importable)
from training.reward_scale import ReturnStatistics, scale_reward

GAMMA = 0.9


def make_rollouts(count: int = 3, rows: int = 2, time: int = 15):
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


def test_however_the_steps_are_cut_into_rollouts_the_last_scale_is_the_same():
    rewards, dones = make_rollouts()
    whole, dones = torch.cat(list(rewards), 1), torch.cat(list(dones), 1)
    at_once = scale_reward(whole, dones, ReturnStatistics.start(2), gamma=GAMMA)[1]
    statistics = ReturnStatistics.start(2)
    for reward, done in zip(whole.split(5, 1), dones.split(5, 1), strict=True):
        _, statistics = scale_reward(reward, done, statistics, gamma=GAMMA)
    for a, b in zip(statistics, at_once, strict=True):
        torch.testing.assert_close(a, b)


def test_scaled_rewards_stay_within_the_clip():
    reward = torch.zeros(1, 400, 1)
    reward[0, 7] = -1.0
    done = torch.zeros_like(reward, dtype=torch.bool)
    scaled, _ = scale_reward(reward, done, ReturnStatistics.start(1), gamma=0.0, clip=2.0)
    assert scaled.amin() == -2.0
    assert scaled.dtype == reward.dtype


def test_the_statistics_survive_a_file():
    rewards, dones = make_rollouts()
    statistics = scale_reward(rewards[0], dones[0], ReturnStatistics.start(2), gamma=GAMMA)[1]
    restored = ReturnStatistics(**saved(statistics._asdict()))
    for state in (statistics, restored):
        scaled, _ = scale_reward(rewards[1], dones[1], state, gamma=GAMMA)
        torch.testing.assert_close(scaled, rewards[1] * (scaled / rewards[1]).mean())
    assert all(torch.equal(a, b) for a, b in zip(statistics, restored, strict=True))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_reward_that_is_no_number_is_refused(bad):
    rewards, dones = make_rollouts()
    rewards[0, 1, 2] = bad
    with pytest.raises(ValueError, match="`reward` holds NaN or an infinity"):
        scale_reward(rewards[0], dones[0], ReturnStatistics.start(2), gamma=GAMMA)
