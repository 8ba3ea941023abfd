"""Duties of every transform; see contracts.py."""

from __future__ import annotations

import copy
import pickle
from functools import partial
from typing import Any

import pytest
import torch
from contract_environments import (
    ACTION,
    OBS,
    StaircaseEnv,
    extend_and_sample,
    gym_env,
    parallel_env,
    saved,
    with_transform,
)
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import (
    LazyTensorStorage,
    TensorDictReplayBuffer,
)
from torchrl.envs import (
    Compose,
    EnvBase,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs


class TransformContract:
    """Duties of a transform. Hooks to fill in: `make_transform` and `check_output`.

    Attributes:
        offline: whether the transform works on a replay buffer and in a model ("works") or must
            refuse there with NotImplementedError ("raises").
        refused_in_workers: None, or the text that the error must hold when an environment with the
            transform is put into SerialEnv or ParallelEnv workers.
        keeps_float64: the keys that must be float64 where the observation is.
    """

    offline: str = "raises"
    refused_in_workers: str | None = None
    keeps_float64: tuple[Any, ...] = ("observation",)

    # --- hooks
    def make_transform(self) -> Transform:
        """Return a fresh transform, equal to every other that this method returns."""
        raise NotImplementedError

    def check_output(self, before: TensorDictBase, after: TensorDictBase) -> None:
        """Assert that `after` is what the transform makes of an observation.

        `before` is the data that went in where that is known (it holds "observation"), and empty in
        the tests with a real simulator.
        """
        raise NotImplementedError

    def make_env(self) -> EnvBase:
        """Return the simulator, a TransformedEnv, without the transform."""
        return gym_env()

    def make_batched_env(self) -> EnvBase:
        """Return a batched environment whose rows end at different steps."""
        return TransformedEnv(StaircaseEnv(), Compose())

    def make_data(self, batch: tuple[int, ...], dtype: torch.dtype = torch.float32) -> TensorDict:
        """Return what an environment's step would give to the transform."""
        generator = torch.Generator().manual_seed(1)
        shape = torch.Size(batch)
        return TensorDict(
            {
                "observation": torch.randn(*shape, OBS, generator=generator, dtype=dtype),
                "reward": torch.ones(*shape, 1, dtype=dtype),
                "done": torch.zeros(*shape, 1, dtype=torch.bool),
                "terminated": torch.zeros(*shape, 1, dtype=torch.bool),
            },
            shape,
        )

    def make_root(self, batch: tuple[int, ...], dtype: torch.dtype = torch.float32) -> TensorDict:
        """Return the data at the step before, with the action that led to `make_data`."""
        generator = torch.Generator().manual_seed(2)
        data = self.make_data(batch, dtype)
        action = torch.randn(*batch, ACTION, generator=generator, dtype=dtype)
        data.set("action", action)
        return self.make_transform()._reset(data.empty(), data)

    # --- TorchRL's list
    def test_single_trans_env_check(self):
        check_env_specs(with_transform(self.make_env, self.make_transform))
        check_env_specs(
            with_transform(self.make_batched_env, self.make_transform),
            break_when_any_done="both",
        )

    def test_serial_trans_env_check(self):
        factory = partial(with_transform, self.make_env, self.make_transform)
        if self.refused_in_workers is not None:
            with pytest.raises(Exception, match=self.refused_in_workers):
                SerialEnv(2, factory).rollout(2)
            return
        env = SerialEnv(2, factory)
        check_env_specs(env)
        env.close()

    def test_parallel_trans_env_check(self):
        factory = partial(with_transform, self.make_env, self.make_transform)
        if self.refused_in_workers is not None:
            with pytest.raises(Exception, match=self.refused_in_workers):
                parallel_env(2, factory).rollout(2)
            return
        env = parallel_env(2, factory)
        try:
            check_env_specs(env)
        finally:
            env.close(raise_if_closed=False)

    def test_trans_serial_env_check(self):
        env = TransformedEnv(SerialEnv(2, self.make_env), self.make_transform())
        check_env_specs(env)
        env.close()

    def test_trans_parallel_env_check(self):
        env = TransformedEnv(parallel_env(2, self.make_env), self.make_transform())
        try:
            check_env_specs(env)
        finally:
            env.close(raise_if_closed=False)

    @pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
    def test_transform_no_env(self, batch):
        transform, data = self.make_transform(), self.make_data(batch)
        first = transform._reset(data.empty(), data.clone())
        assert first.batch_size == data.batch_size
        self.check_output(data, first)
        transform = self.make_transform()
        after = transform._step(self.make_root(batch), data.clone())
        assert after.batch_size == data.batch_size
        self.check_output(data, after)

    @pytest.mark.parametrize("batch", [(), (3,)])
    def test_transform_compose(self, batch):
        data, root = self.make_data(batch), self.make_root(batch)
        alone = self.make_transform()._step(root, data.clone())
        composed = Compose(Compose(self.make_transform()))._step(root, data.clone())
        self.check_output(data, composed)
        assert set(alone.keys(True, True)) == set(composed.keys(True, True))
        for key in alone.keys(True, True):
            torch.testing.assert_close(composed[key], alone[key], rtol=0, atol=0)

    def test_transform_env(self):
        env = with_transform(self.make_env, self.make_transform)
        nothing = TensorDict({}, [])
        reset = env.reset()
        self.check_output(nothing, reset)
        stepped = env.rand_step(reset)
        self.check_output(nothing, stepped["next"])
        specs = env.full_observation_spec
        for key, leaf in specs.items(True, True):
            assert stepped["next"][key].dtype == leaf.dtype
            assert leaf.is_in(stepped["next"][key])
            assert leaf.is_in(reset[key])

    def test_transform_model(self):
        transform, data = self.make_transform(), self.make_data((3,))
        obs = data["observation"].shape[-1]
        module = TensorDictModule(nn.Linear(obs, 1), ["observation"], ["value"])
        if self.offline == "raises":
            with pytest.raises(NotImplementedError, match=type(transform).__name__):
                nn.Sequential(transform, module)(data)
            return
        after = nn.Sequential(transform, module)(data.clone())
        self.check_output(data, after)
        assert after["value"].shape == (3, 1)

    def test_transform_rb(self):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=4)
        transform, data = self.make_transform(), self.make_data((6,))
        buffer.append_transform(transform)
        if self.offline == "raises":
            with pytest.raises(NotImplementedError, match=type(transform).__name__):
                extend_and_sample(buffer, data)
            return
        buffer.extend(data)
        sample = buffer.sample()
        self.check_output(data[sample["index"]], sample)

    def test_transform_inverse(self):
        data = self.make_data((3,))
        after = self.make_transform().inv(data.clone())
        for key, value in data.items(True, True):
            assert torch.equal(after[key], value)

    # --- this package's list
    def test_float64_is_kept(self):
        after = self.make_transform()._step(
            self.make_root((3,), torch.float64), self.make_data((3,), torch.float64)
        )
        for key in self.keeps_float64:
            assert after[key].dtype == torch.float64

    def test_a_partial_reset_leaves_the_other_rows_alone(self):
        env = with_transform(self.make_batched_env, self.make_transform)
        data = env.rand_step(env.reset())
        root = data["next"].exclude("reward")
        rows = torch.tensor([True, False, True])
        after = env.reset(root.clone().set("_reset", rows[:, None]))
        for key in env.full_observation_spec.keys(True, True):
            assert torch.equal(after[key][1], root[key][1]), key
        self.check_output(TensorDict({}, []), after)

    def test_rollouts_pass_over_the_ends_of_episodes(self):
        env = with_transform(self.make_batched_env, self.make_transform)
        data = env.rollout(12, break_when_any_done=False)
        assert data["next", "done"].any()
        assert data.shape == (3, 12)
        # what the policy reads at t + 1 is what arrived at t, except where an episode began
        going_on = ~data["next", "done"][:, :-1, 0]
        for key in env.full_observation_spec.keys(True, True):
            after = data[key][:, 1:][going_on]
            assert torch.equal(after, data.get(("next", key))[:, :-1][going_on]), key

    def test_the_global_generator_is_untouched(self):
        data, root = self.make_data((3,)), self.make_root((3,))
        torch.manual_seed(0)
        state = torch.get_rng_state()
        transform = self.make_transform()
        transform._reset(data.empty(), data.clone())
        transform._step(root, data.clone())
        assert torch.equal(torch.get_rng_state(), state)

    def test_a_saved_state_goes_on_as_if_never_stopped(self):
        data, root = self.make_data((3,)), self.make_root((3,))
        first, second = self.make_transform(), self.make_transform()
        first._reset(data.empty(), data.clone())
        first._step(root, data.clone())
        second.load_state_dict(saved(first.state_dict()))
        expected, received = first._step(root, data.clone()), second._step(root, data.clone())
        for key in expected.keys(True, True):
            assert torch.equal(received[key], expected[key]), key

    @pytest.mark.parametrize("how", ["clone", "deepcopy", "pickle"])
    def test_a_copy_goes_its_own_way_from_the_same_state(self, how):
        data, root = self.make_data((3,)), self.make_root((3,))
        first = self.make_transform()
        first._step(root, data.clone())
        if how == "clone":
            second = first.clone()
        elif how == "deepcopy":
            second = copy.deepcopy(first)
        else:
            second = pickle.loads(pickle.dumps(first))
        assert second.container is None
        # stepping the copy first must not advance the original
        received, expected = second._step(root, data.clone()), first._step(root, data.clone())
        for key in expected.keys(True, True):
            assert torch.equal(received[key], expected[key]), key

    def test_an_absent_observation_is_named(self):
        transform = self.make_transform()
        if not transform.in_keys:
            pytest.skip("reads nothing")
        with pytest.raises(KeyError, match=type(transform).__name__):
            transform._step(self.make_root((3,)), TensorDict({}, [3]))
