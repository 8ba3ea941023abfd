"""Environments and helpers that the suites share; see suites.py."""

import copy
import io

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    EnvBase,
    GymEnv,
    InitTracker,
    ParallelEnv,
    TransformedEnv,
)

from torchrl_drbpn import ObservationMissingness, PreviousAction

OBS, ACTION = 5, 2


class StaircaseEnv(EnvBase):
    """A batched environment whose observation is known: 100 b + t + i/10 in row b, component i.

    Row b terminates at step `horizon + b`, so that the rows of a batch are reset at different
    times. The reward is 1 a step. Actions change nothing.
    """

    def __init__(self, batch=3, horizon=3, obs=OBS, dtype=torch.float32):
        super().__init__(batch_size=[batch], device="cpu")
        shape = (batch,)
        self.observation_spec = Composite(
            observation=Bounded(-1e4, 1e4, shape=(*shape, obs), dtype=dtype), shape=shape
        )
        self.action_spec = Unbounded(shape=(*shape, ACTION), dtype=dtype)
        self.reward_spec = Unbounded(shape=(*shape, 1))
        done = Categorical(2, shape=(*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(done=done, terminated=done.clone(), shape=shape)
        self.last = horizon + torch.arange(batch)
        self.time = torch.zeros(batch, dtype=torch.int64)
        self.ramp = torch.arange(obs, dtype=dtype) / 10 + 100.0 * torch.arange(batch)[:, None]

    def _observe(self):
        observation = (self.ramp + self.time[:, None]).to(self.ramp.dtype)
        done = (self.time >= self.last)[:, None]
        entries = {"observation": observation, "done": done, "terminated": done.clone()}
        return TensorDict(entries, self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        del kwargs
        rows = None if tensordict is None else tensordict.get("_reset", None)
        if rows is None:
            self.time = torch.zeros_like(self.time)
        else:
            self.time = self.time.masked_fill(rows.reshape(-1), 0)
        return self._observe()

    def _step(self, tensordict):
        del tensordict
        self.time = self.time + 1
        return self._observe().set("reward", torch.ones(*self.batch_size, 1))

    def _set_seed(self, seed):
        del seed


class AgentsEnv(StaircaseEnv):
    """Two agents that see what StaircaseEnv shows, in a folder of their own."""

    def __init__(self):
        super().__init__()
        shape = (*self.batch_size, 2)
        leaf = self.observation_spec["observation"].unsqueeze(1).expand(*shape, OBS)
        agents = Composite(observation=leaf, shape=shape)
        self.observation_spec = Composite(agents=agents, shape=self.batch_size)

    def _observe(self):
        data = super()._observe()
        seen = data.pop("observation").unsqueeze(1).repeat(1, 2, 1)
        return data.set("agents", TensorDict({"observation": seen}, seen.shape[:-1]))


def gym_env(name="InvertedPendulum-v5"):
    """Return a Gymnasium environment in float32, one process, batch size ()."""
    return TransformedEnv(GymEnv(name), DoubleToFloat())


def parallel_env(workers, factory):
    """Return a ParallelEnv whose processes start quickly; `factory` must be picklable."""
    return ParallelEnv(workers, factory, mp_start_method="fork")


def saved(state):
    """Return `state` after a trip through a file that is read without running code."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


def heirs(first, second, run):
    """Return what `second` and a copy give with the state of `first`, and what `first` gave."""
    with torch.no_grad():
        for parameter in first.parameters():
            parameter += 0.05
    second.load_state_dict(saved(first.state_dict()))
    copied, expected = copy.deepcopy(first), run(first)
    with torch.no_grad():
        for parameter in first.parameters():  # which a copy does not share
            parameter.zero_()
    return [run(second), run(copied)], expected


def staircase(*transforms, **kwargs):
    return TransformedEnv(StaircaseEnv(**kwargs), Compose(*transforms))


def vectors(value=1.0, batch=(4,), **more):
    """Return observations of one value, as a step would give them."""
    return TensorDict({"observation": torch.full((*batch, OBS), value), **more}, batch)


def belief_env(primer=None, name="InvertedPendulum-v5"):
    """Return an environment that writes what every belief module reads, batch size ()."""
    env = TransformedEnv(GymEnv(name), Compose())
    return with_belief_entries(env, primer)


def actions_in_float64():
    """Return the transform that lets a float64 policy act in a simulator of float32 actions."""
    return DTypeCastTransform(torch.float32, torch.float64, in_keys=[], in_keys_inv=["action"])


def with_belief_entries(env, primer=None, *, to_float32=True):
    """Append what every belief module reads; half of the entries are missing."""
    for transform in (
        DoubleToFloat() if to_float32 else actions_in_float64(),
        PreviousAction(),
        ObservationMissingness("mcar", 0.5, always_observed=0.0),
        InitTracker(),
        primer,
    ):
        if transform is not None:
            env.append_transform(transform)
    return env
