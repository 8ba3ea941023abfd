"""RolloutPolicy: what the agent's policy writes, from the same random numbers.

To the last bit in PyTorch's operations, to rounding where its head is one call of C.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import ExplorationType, set_exploration_type

pytest.importorskip("hydra")
from recipe_tools import make_config  # isort: skip

from training import decision
from training.config import read_settings
from training.decision import RolloutPolicy
from training.loop import Training, assemble

from torchrl_drbpn.functional import native_error

SMALL = ("env=inverted_pendulum", "experiment=smoke")


def make(belief: str) -> tuple[Training, RolloutPolicy, TensorDictBase]:
    training = assemble(read_settings(make_config(*SMALL, f"belief={belief}")))
    return training, RolloutPolicy(training.agent), training.env.reset()


@torch.no_grad()
def decide(
    policy: Callable[[TensorDictBase], TensorDictBase],
    root: TensorDictBase,
    mode: ExplorationType = ExplorationType.RANDOM,
) -> TensorDictBase:
    torch.manual_seed(0)
    with set_exploration_type(mode):
        return policy(root.copy())


def assert_same(first: TensorDictBase, second: TensorDictBase, exact: bool = True) -> None:
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    for key, value in first.items(True, True):
        if exact:
            assert torch.equal(value, second[key]), key
        else:
            torch.testing.assert_close(value, second[key], rtol=1e-5, atol=1e-6, msg=str(key))


@pytest.fixture(params=["C", "PyTorch"])
def exact(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the head runs in PyTorch's operations; else it must have run in C."""
    if request.param == "PyTorch":
        monkeypatch.setattr(decision, "policy_refusal", lambda *_: "not wanted")
        return True
    if native_error(torch.float32, "heads") is not None:
        pytest.skip("no C compiler here")
    return False


@pytest.mark.parametrize("belief", ["drbpn", "gru", "none"])
@pytest.mark.parametrize("mode", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_it_decides_as_the_agent_does(belief: str, mode: ExplorationType, exact: bool) -> None:
    training, policy, root = make(belief)
    for _ in range(3):
        expected = decide(training.agent.policy, root, mode)
        assert_same(expected, decide(policy, root, mode), exact)
        if mode is ExplorationType.RANDOM:
            assert (policy._prepared is None) == exact
        _, root = training.env.step_and_maybe_reset(expected)


def test_a_refresh_takes_the_new_parameters(exact: bool) -> None:
    training, policy, root = make("drbpn")
    decide(policy, root)
    with torch.no_grad():
        for parameter in training.agent.parameters():
            parameter.add_(0.1)
    policy.refresh()
    assert_same(decide(training.agent.policy, root), decide(policy, root), exact)


def test_another_number_of_robots_is_laid_out_anew(exact: bool) -> None:
    training, policy, root = make("drbpn")
    decide(policy, root)
    fewer = root[:1]
    assert_same(decide(training.agent.policy, fewer), decide(policy, fewer), exact)


def test_every_rollout_of_the_collector_begins_with_a_refresh() -> None:
    training, _, _ = make("drbpn")
    training.collector.rollout()
    with torch.no_grad():
        training.agent.scale.state_independent_scale.fill_(-2.0)
    scale = training.collector.rollout()["scale"]
    assert torch.allclose(scale, torch.tensor(-2.0).exp())


def test_gradients_come_from_the_actor() -> None:
    _, policy, root = make("drbpn")
    out = policy(root.copy())
    assert out["action_log_prob"].requires_grad


def test_it_can_be_copied_and_pickled_after_a_decision(exact: bool) -> None:
    _, policy, root = make("drbpn")
    expected = decide(policy, root)
    for copied in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert_same(expected, decide(copied, root))
