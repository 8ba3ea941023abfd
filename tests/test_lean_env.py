"""LeanTransformedEnv: the same as TorchRL's TransformedEnv, to the last bit, key and random number.

The reference is TorchRL's own step over the same simulators. Both are compared at every step, the
root of the next step included, and the roots of earlier steps must stay what they were.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Unbounded
from torchrl.envs import (
    ClipTransform,
    Compose,
    EnvBase,
    InitTracker,
    RewardScaling,
    RewardSum,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_drbpn import (
    GymnasiumBatchEnv,
    MaskedObservationNorm,
    ObservationMissingness,
    ObservationNoise,
    PreviousAction,
    RunningReturnScale,
)
from torchrl_drbpn.envs import LeanTransformedEnv
from torchrl_drbpn.envs.stepping import Plan

NUM_ENVS, STEPS = 4, 60


class ReadsTheCount(Transform):
    """Copy the step count, at steps and resets: it has to be there for whoever comes later."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("copied", next_tensordict["step_count"].clone())

    def _reset(self, tensordict: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        return reset.set("copied", reset["step_count"] + 100)

    def transform_observation_spec(self, observation_spec: TensorDictBase) -> TensorDictBase:
        observation_spec["copied"] = observation_spec["step_count"].clone()
        return observation_spec


class Marks(Transform):
    """Change the next root by the hook that only TorchRL's own way calls."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        return reset

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, following: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        return tensordict, following.set("marked", torch.ones(NUM_ENVS, 1))


def recurrent() -> TensorDictPrimer:
    return TensorDictPrimer({("memory", "mean"): Unbounded((2,))}, expand_specs=True)


CHAINS: dict[str, Callable[[], list[Transform]]] = {
    "none": list,
    "recipe": lambda: [
        PreviousAction(),
        ObservationNoise(0.01),
        ObservationMissingness("mar", 0.5),
        MaskedObservationNorm(),
        RunningReturnScale(0.99, out_keys="scaled_reward"),
        RewardSum(in_keys=["reward"], out_keys=["episode_reward"]),
        StepCounter(),
        InitTracker(),
        recurrent(),
    ],
    "a step limit of TorchRL's": lambda: [InitTracker(), StepCounter(max_steps=7)],
    "another transform after the counter": lambda: [StepCounter(), ReadsTheCount(), RewardSum()],
    "actions and rewards": lambda: [
        RewardScaling(0.5, 2.0),
        ClipTransform(in_keys=[], in_keys_inv=["action"], low=-0.1, high=0.1),
        PreviousAction(),
    ],
    "a primer that is not zero": lambda: [
        TensorDictPrimer(start=Unbounded((2,)), default_value=3.0, expand_specs=True)
    ],
    "a hook": lambda: [StepCounter(), Marks()],
}


def make(cls: type[TransformedEnv], chain: str, **kwargs: object) -> TransformedEnv:
    base = GymnasiumBatchEnv("InvertedPendulum-v5", NUM_ENVS, seed=0, **kwargs)
    return cls(base, Compose(*CHAINS[chain]()))


def decide(root: TensorDictBase, t: int) -> None:
    """Write what a policy with a memory writes, some of it under names that no spec knows."""
    generator = torch.Generator().manual_seed(t)
    root["action"] = 6 * torch.rand(NUM_ENVS, 1, generator=generator) - 3
    root["logits"] = torch.full((NUM_ENVS,), float(t))
    root["belief"] = TensorDict(mean=torch.full((NUM_ENVS, 2), float(t)), batch_size=[NUM_ENVS])
    root["next", "memory", "mean"] = torch.full((NUM_ENVS, 2), float(t))


def trajectory(env: EnvBase, steps: int = STEPS) -> list[TensorDictBase]:
    """Return every stepped root and the root that followed it."""
    root, seen, kept = env.reset(), [], []
    for t in range(steps):
        decide(root, t)
        stepped, root = env.step_and_maybe_reset(root)
        seen += [stepped.clone(), root.clone()]
        kept.append(stepped)
    for then, now in zip(seen[::2], kept, strict=True):
        assert_same(then, now)
    return seen


def assert_same(first: TensorDictBase, second: TensorDictBase) -> None:
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    for key, value in first.items(True, True):
        other = second[key]
        assert value.dtype == other.dtype, key
        assert torch.equal(value, other), key


@pytest.mark.parametrize("chain", CHAINS)
def test_it_steps_and_resets_as_transformed_env_does(chain: str) -> None:
    expected = trajectory(make(TransformedEnv, chain))
    assert any(bool(root["next", "done"].any()) for root in expected[::2])
    for first, second in zip(expected, trajectory(make(LeanTransformedEnv, chain)), strict=True):
        assert_same(first, second)


def test_rows_that_all_end_at_once_are_reset_as_transformed_env_does() -> None:
    # Swimmer never terminates, so that the time limit ends every row in the same step.
    def run(cls: type[TransformedEnv]) -> list[TensorDictBase]:
        base = GymnasiumBatchEnv("Swimmer-v5", NUM_ENVS, seed=0, max_episode_steps=3)
        env = cls(base, Compose(*CHAINS["recipe"]()))
        root, seen = env.reset(), []
        for _ in range(8):
            root["action"] = torch.ones(NUM_ENVS, 2)
            root["left over"] = torch.ones(NUM_ENVS)
            stepped, root = env.step_and_maybe_reset(root)
            seen += [stepped.clone(), root.clone()]
        return seen

    for first, second in zip(run(TransformedEnv), run(LeanTransformedEnv), strict=True):
        assert_same(first, second)


def test_the_batch_by_itself_steps_as_torchrl_would_step_it() -> None:
    class Plain(GymnasiumBatchEnv):
        _step_and_maybe_reset = EnvBase._step_and_maybe_reset

    expected = trajectory(Plain("InvertedPendulum-v5", NUM_ENVS, seed=0))
    lean = trajectory(GymnasiumBatchEnv("InvertedPendulum-v5", NUM_ENVS, seed=0))
    for first, second in zip(expected, lean, strict=True):
        assert_same(first, second)


@pytest.mark.parametrize(("chain", "short"), [("recipe", True), ("a hook", False)])
def test_the_short_way_is_taken_where_it_can_be(chain: str, short: bool) -> None:
    env = make(LeanTransformedEnv, chain)
    trajectory(env, steps=1)
    assert env._plan.usable is short


def test_a_transform_that_is_appended_later_is_stepped() -> None:
    env = make(LeanTransformedEnv, "recipe")
    trajectory(env, steps=2)
    env.append_transform(ReadsTheCount())
    stepped = trajectory(env, steps=3)[-2]
    assert torch.equal(stepped["next", "copied"], stepped["next", "step_count"])


def test_a_masked_step_goes_torchrls_way() -> None:
    def run(cls: type[TransformedEnv]) -> TensorDictBase:
        env = make(cls, "recipe")
        root = env.reset()
        decide(root, 0)
        root["_step"] = torch.tensor([True, False, True, True])
        return env.step_and_maybe_reset(root)[0]

    assert_same(run(TransformedEnv), run(LeanTransformedEnv))


def test_torchrl_checks_its_specs_and_its_data() -> None:
    check_env_specs(make(LeanTransformedEnv, "recipe"), break_when_any_done="both")


def test_a_copy_of_a_stepped_environment_goes_on_by_itself() -> None:
    env = GymnasiumBatchEnv("InvertedPendulum-v5", NUM_ENVS, seed=0)
    trajectory(env, steps=3)
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = trajectory(env, steps=3)
    for twin in twins:
        for first, second in zip(expected, trajectory(twin, steps=3), strict=True):
            assert_same(first, second)
        assert isinstance(twin._plan, Plan)
        assert twin._plan is not env._plan
