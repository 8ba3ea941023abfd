"""MaskedObservationNorm: running mean and variance of the observed entries alone.

Specified here: every received observation is learned from once, the first of an episode included,
rows that are not reset or not stepped excluded; missing entries stay 0 and never enter; a complete
observation is scaled but not learned from; frozen statistics never change; the state survives a
file; learning in several processes is refused. On top, the duties of every transform.
"""

import pickle

import pytest
import torch
from contracts import OBS, StaircaseEnv, TransformContract, gym_env, saved, with_transform
from self_resetting import SelfResettingEnv
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_drbpn.transforms import (
    FillLastObserved,
    MaskedObservationNorm,
    ObservationMissingness,
    ObservationNoise,
)

TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def draw(samples, obs, seed=0, missing=0.4, dtype=torch.float64):
    """Return values with NaN where they are missing, and the mask."""
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(samples, obs, generator=generator, dtype=dtype)
    value = value * torch.arange(1, obs + 1) + 10 * torch.arange(obs)
    observed = torch.rand(samples, obs, generator=generator) >= missing
    return torch.where(observed, value, torch.nan), observed


def step_data(value, observed=None, **more):
    """Return what a simulator would write at a step, missing entries 0."""
    entries = {"observation": value.nan_to_num(), **more}
    if observed is not None:
        entries["observed"] = observed
    return TensorDict(entries, value.shape[:-1])


def learn(norm, value, observed=None, **more):
    """Show one batch to the transform, as a step would."""
    data = step_data(value, observed, **more)
    return norm._step(data.empty(), data)


def learned(obs):
    """Return the transform with the statistics of a few steps."""
    norm = MaskedObservationNorm()
    learn(norm, *draw(50, obs))
    return norm


def state(norm):
    """Return a copy of the statistics."""
    return {key: entry.clone() for key, entry in norm.state_dict().items()}


def same(first, second):
    """Tell whether two sets of statistics are equal to the last bit."""
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


# ----------------------------------------------------------------------------------------- duties
class Base(TransformContract):
    def make_data(self, batch, dtype=torch.float32):
        data = super().make_data(batch, dtype)
        observed = torch.rand(data["observation"].shape, generator=torch.Generator().manual_seed(3))
        data["observed"] = observed < 0.5
        data["observation"] = data["observation"] * data["observed"]
        return data

    def make_env(self):
        return gym_env().append_transform(ObservationMissingness("mcar", 0.5))

    def make_batched_env(self):
        return super().make_batched_env().append_transform(ObservationMissingness("mcar", 0.5))

    def check_output(self, before, after):
        observation = after["observation"]
        assert (observation.abs() <= 10).all()
        assert (observation[~after["observed"]] == 0).all()
        if "observation" in before:
            assert observation.shape == before["observation"].shape


class TestLearningNormContract(Base):
    refused_in_workers = "MaskedObservationNorm cannot learn inside a SerialEnv or ParallelEnv"

    def make_transform(self):
        return MaskedObservationNorm()


class TestFrozenNormContract(Base):
    """Its statistics have a shape, so that every environment has as many sensors as gym_env()."""

    offline = "works"

    def make_transform(self):
        return learned(4).freeze()

    def make_data(self, batch, dtype=torch.float32):
        data = super().make_data(batch, dtype)
        for key in ("observation", "observed"):
            data[key] = data[key][..., :4]
        return data

    def make_batched_env(self):
        env = TransformedEnv(StaircaseEnv(obs=4), Compose())
        return env.append_transform(ObservationMissingness("mcar", 0.5))


# ----------------------------------------------------------------------- learning in environments
class RandomEnv(StaircaseEnv):
    """Random observations; keeps what it sent, and sends NaN in rows that are not reset."""

    def __init__(self, batch=4, horizon=3):
        super().__init__(batch=batch, horizon=horizon)
        self.generator = torch.Generator().manual_seed(0)
        self.sent = []

    def _observe(self):
        data = super()._observe()
        noise = torch.randn(data["observation"].shape, generator=self.generator)
        data["observation"] = noise * torch.arange(1, OBS + 1) + 50
        return data

    def _reset(self, tensordict=None, **kwargs):
        rows = None if tensordict is None else tensordict.get("_reset", None)
        data = super()._reset(tensordict, **kwargs)
        rows = torch.ones(self.batch_size).bool() if rows is None else rows.reshape(-1)
        self.sent.append(data["observation"][rows])
        data["observation"] = torch.where(rows[:, None], data["observation"], torch.nan)
        return data

    def _step(self, tensordict):
        data = super()._step(tensordict)
        self.sent.append(data["observation"].clone())
        return data


def test_every_received_observation_is_learned_from_once():
    env = TransformedEnv(RandomEnv(), MaskedObservationNorm())
    data = env.rollout(20, break_when_any_done=False)
    assert data["next", "done"].sum() > 8
    sent = torch.cat(env.base_env.sent).double()
    norm = env.transform
    assert (norm.moments[0].count == len(sent)).all()
    torch.testing.assert_close(norm.loc, sent.mean(0), **TIGHT)
    torch.testing.assert_close(norm.scale, (sent.var(0, correction=0) + 1e-8).sqrt(), **TIGHT)


def test_each_observation_is_scaled_by_what_was_seen_up_to_it():
    env = TransformedEnv(RandomEnv(horizon=100), MaskedObservationNorm())
    data = env.rollout(6)
    sent = env.base_env.sent
    received = [data["observation"][:, 0], *data["next", "observation"].unbind(1)]
    assert len(sent) == len(received) == 7
    for t, observation in enumerate(received):
        past = torch.cat(sent[: t + 1]).double()
        scale = (past.var(0, correction=0) + 1e-8).sqrt()
        expected = (sent[t] - past.mean(0)) / scale
        torch.testing.assert_close(observation, expected.float(), rtol=1e-6, atol=1e-6)


def test_of_masked_observations_only_the_observed_entries_count():
    env = RandomEnv()
    chain = Compose(ObservationMissingness("mcar", 0.6, seed=0), MaskedObservationNorm())
    env = TransformedEnv(env, chain)
    data = env.rollout(30, break_when_any_done=False)
    # all first observations, and every "next" one: those are all that were sent
    first = torch.ones(4, 30, dtype=torch.bool)
    first[:, 1:] = data["next", "done"][:, :-1, 0]
    observed = torch.cat([data["observed"][first], data["next", "observed"].reshape(-1, OBS)])
    assert torch.equal(chain[1].moments[0].count, observed.double().sum(0))
    # the same masks over the same simulator, without the normaliser: what it must have seen
    plain = TransformedEnv(RandomEnv(), ObservationMissingness("mcar", 0.6, seed=0))
    raw = plain.rollout(30, break_when_any_done=False)
    value = torch.cat([raw["observation"][first], raw["next", "observation"].reshape(-1, OBS)])
    for i in range(OBS):
        kept = value[observed[:, i], i].double()
        torch.testing.assert_close(env.transform[1].loc[i], kept.mean(), **TIGHT)
        std = (kept.var(correction=0) + 1e-8).sqrt()
        torch.testing.assert_close(env.transform[1].scale[i], std, **TIGHT)
    assert (data["observation"][~data["observed"]] == 0).all()


def test_over_a_serial_env_it_learns_from_the_rows_that_are_reset():
    def one():
        return TransformedEnv(StaircaseEnv(batch=1, horizon=2), Compose())

    def two():
        return TransformedEnv(StaircaseEnv(batch=1, horizon=5), Compose())

    env = TransformedEnv(SerialEnv(2, [one, two]), MaskedObservationNorm())
    data = env.rollout(12, break_when_any_done=False)
    resets = 2 + data["next", "done"][:, :, :-1].sum()
    assert resets > 6
    assert (env.transform.moments[0].count == 2 * 12 + resets).all()


def test_an_environment_that_resets_itself_sends_every_observation_once():
    env = TransformedEnv(SelfResettingEnv(), MaskedObservationNorm())
    data = env.rollout(11, break_when_any_done=False)
    assert data["next", "done"].any()
    assert (env.transform.moments[0].count == 3 * 12).all()


def test_rows_that_did_not_step_are_not_learned_from():
    env = TransformedEnv(
        SerialEnv(2, [_short_env, _long_env]),
        MaskedObservationNorm(),
    )
    env.set_seed(0)
    # of drawn actions some would let the pendulum fall before its sixth step
    resting = lambda td: td.set("action", torch.zeros(2, 1))  # noqa: E731
    data = env.rollout(6, resting, break_when_any_done=False, break_when_all_done=True)
    # 3 + 6 steps were taken and 2 resets; the other rows repeat what they had
    assert data["next", "done"].any()
    assert (env.transform.moments[0].count == 3 + 6 + 2).all()


def _short_env():
    return TransformedEnv(GymEnv("InvertedPendulum-v5"), Compose(DoubleToFloat(), StepCounter(3)))


def _long_env():
    return TransformedEnv(GymEnv("InvertedPendulum-v5"), Compose(DoubleToFloat(), StepCounter(6)))


# ------------------------------------------------------------------------------- masks and limits
def test_missing_entries_are_exactly_zero_whatever_they_hold():
    value, observed = draw(64, 3)
    for junk in (0.0, float("nan"), float("inf"), 1e300):
        norm = MaskedObservationNorm()
        data = TensorDict(
            observation=torch.where(observed, value, junk), observed=observed, batch_size=64
        )
        after = norm._step(data.empty(), data)["observation"]
        assert (after[~observed] == 0).all()
        mean = torch.stack([value[observed[:, i], i].mean() for i in range(3)])
        torch.testing.assert_close(norm.loc, mean, **TIGHT)


def test_nothing_observed_changes_nothing():
    norm = MaskedObservationNorm()
    value, observed = draw(8, 3)
    learn(norm, value, observed)
    before = state(norm)
    after = learn(norm, value + 5, torch.zeros_like(observed))
    assert same(state(norm), before)
    assert (after["observation"] == 0).all()


def test_without_a_mask_everything_counts_as_observed():
    value, _ = draw(8, 3, missing=0.0)
    bare, masked = MaskedObservationNorm(), MaskedObservationNorm()
    first = learn(bare, value)
    second = learn(masked, value, torch.ones(8, 3, dtype=torch.bool))
    torch.testing.assert_close(first["observation"], second["observation"], **TIGHT)
    torch.testing.assert_close(bare.scale, masked.scale, **TIGHT)


@pytest.mark.parametrize("clip", [0.5, 2.0, None])
def test_normalised_entries_stay_within_the_clip(clip):
    norm = MaskedObservationNorm(clip=clip)
    value, _ = draw(500, 2, missing=0.0)
    largest = learn(norm, value)["observation"].abs().max()
    assert largest == clip if clip is not None else largest > 2.0


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
def test_statistics_pool_over_every_batch_dimension(batch):
    norm, flat = MaskedObservationNorm(), MaskedObservationNorm()
    for seed in range(4):
        value, observed = draw(6, 3, seed)
        count = max(1, torch.Size(batch).numel())
        learn(norm, value[:count].reshape(*batch, 3), observed[:count].reshape(*batch, 3))
        learn(flat, value[:count], observed[:count])
    assert same(state(norm), state(flat))


def test_several_observations_have_statistics_and_masks_of_their_own():
    norm = MaskedObservationNorm(["joints", ("arm", "touch")], ["joints_seen", ("arm", "seen")])
    joints, joints_seen = draw(30, 3, seed=1)
    touch, seen = draw(30, 2, seed=2)
    data = TensorDict(
        {
            "joints": joints,
            "joints_seen": joints_seen,
            ("arm", "touch"): touch,
            ("arm", "seen"): seen,
        },
        30,
    )
    norm._step(data.empty(), data)
    assert torch.equal(norm.moments[0].count, joints_seen.double().sum(0))
    assert torch.equal(norm.moments[1].count, seen.double().sum(0))
    assert (data["arm", "touch"][~seen] == 0).all()


def test_with_other_out_keys_the_observation_stays_as_it_was():
    env = TransformedEnv(StaircaseEnv(), MaskedObservationNorm(out_keys="normalised"))
    check_env_specs(env)
    data = env.rollout(3)
    expected = TransformedEnv(StaircaseEnv(), Compose()).rollout(3)
    assert torch.equal(data["observation"], expected["observation"])
    assert (data["normalised"].abs() <= 10).all()


def test_what_was_filled_in_before_is_scaled_and_not_learned_from():
    chain = Compose(
        ObservationMissingness("mcar", 0.5), FillLastObserved(), MaskedObservationNorm()
    )
    env = TransformedEnv(StaircaseEnv(horizon=9), chain)
    data = env.rollout(8)
    norm = chain[2].freeze()
    last = TensorDict(observation=data["next", "last_observation"][:, -1], batch_size=3)
    expected = norm._step(last.empty(), last)["observation"]
    assert torch.equal(data["next", "observation"][:, -1], expected)
    count = data["observed"][:, 0].sum(0) + data["next", "observed"].sum((0, 1))
    assert torch.equal(norm.moments[0].count, count.double())


# --------------------------------------------------------------------------- complete observation
def test_a_complete_observation_is_scaled_with_the_same_statistics():
    norm = MaskedObservationNorm()
    value, observed = draw(40, 3, missing=0.5)
    complete = torch.where(observed, value, 7.0)
    after = learn(norm, value, observed, complete_observation=complete)
    expected = ((complete - norm.loc) / norm.scale).clamp(-10, 10)
    torch.testing.assert_close(after["complete_observation"], expected, **TIGHT)
    seen = after["observed"]
    assert torch.equal(after["complete_observation"][seen], after["observation"][seen])


def test_a_complete_observation_is_not_learned_from():
    value, observed = draw(40, 3, missing=0.5)
    first, second = MaskedObservationNorm(), MaskedObservationNorm()
    learn(first, value, observed, complete_observation=torch.full((40, 3), 1e6).double())
    learn(second, value, observed)
    assert same(state(first), state(second))


def test_a_recorded_complete_observation_passes_the_environment_checks():
    chain = Compose(
        ObservationNoise(0.1, complete_key="complete_observation"),
        ObservationMissingness("mcar", 0.5),
        MaskedObservationNorm(),
    )
    env = gym_env().append_transform(chain)
    check_env_specs(env)
    data = env.rollout(20)
    assert (data["complete_observation"].abs() <= 10).all()


# ------------------------------------------------------------------------------- freezing, copies
def test_a_frozen_instance_never_changes():
    norm = MaskedObservationNorm()
    value, observed = draw(16, 3)
    learn(norm, value, observed)
    before = state(norm)
    assert norm.freeze() is norm
    assert norm.frozen
    for seed in range(3):
        learn(norm, *draw(16, 3, seed))
    data = step_data(*draw(16, 3, 5))
    norm._reset(data.empty(), data)
    assert same(state(norm), before)
    norm.unfreeze()
    assert not norm.frozen
    learn(norm, value, observed)
    assert not same(state(norm), before)


def test_a_frozen_copy_scales_alike_and_shares_nothing():
    norm = MaskedObservationNorm()
    value, observed = draw(16, 3)
    learn(norm, value, observed)
    twin = norm.frozen_copy()
    assert twin.frozen
    assert not norm.frozen
    before = state(twin)
    probe = step_data(value, observed)
    expected = norm.frozen_copy()._step(probe.empty(), probe.clone())["observation"]
    learn(norm, value + 100, observed)
    assert same(state(twin), before)
    assert torch.equal(twin._step(probe.empty(), probe.clone())["observation"], expected)
    trained = state(norm)
    twin.load_state_dict({key: entry * 0 for key, entry in before.items()})
    assert same(state(norm), trained)


def test_an_environment_for_evaluation_takes_a_frozen_copy():
    train = TransformedEnv(StaircaseEnv(), MaskedObservationNorm())
    train.rollout(5)
    test = TransformedEnv(StaircaseEnv(), train.transform.frozen_copy())
    before = state(train.transform)
    test.rollout(5)
    assert same(state(train.transform), before)
    assert same(state(test.transform), before)


def test_a_frozen_copy_works_in_workers():
    norm = MaskedObservationNorm()
    gym_env().append_transform(norm).rollout(20)
    frozen = norm.frozen_copy()
    env = SerialEnv(2, lambda: gym_env().append_transform(frozen.clone()))
    check_env_specs(env)


# ------------------------------------------------------------------------------------------ state
def test_the_state_survives_a_file_read_without_running_code():
    norm = MaskedObservationNorm()
    learn(norm, *draw(16, 3))
    fresh = MaskedObservationNorm()
    fresh.load_state_dict(saved(norm.state_dict()))
    assert same(state(fresh), state(norm))
    assert torch.equal(fresh.scale, norm.scale)


def test_the_state_of_an_environment_holds_the_statistics():
    env = TransformedEnv(StaircaseEnv(), Compose(StepCounter(), MaskedObservationNorm()))
    env.rollout(4)
    other = TransformedEnv(StaircaseEnv(), Compose(StepCounter(), MaskedObservationNorm()))
    other.load_state_dict(saved(env.state_dict()))
    assert same(state(other.transform[1]), state(env.transform[1]))


def test_a_state_taken_earlier_stays_what_it_was():
    norm = MaskedObservationNorm()
    learn(norm, *draw(16, 3))
    early = norm.state_dict()
    frozen_in_time = {key: entry.clone() for key, entry in early.items()}
    learn(norm, *draw(16, 3, seed=1))
    later = {key: entry.clone() for key, entry in norm.state_dict().items()}
    assert same(early, frozen_in_time)
    norm.load_state_dict(early)
    norm.load_state_dict(later)
    assert same(early, frozen_in_time)


def test_an_unused_state_clears_the_statistics():
    norm = MaskedObservationNorm()
    learn(norm, *draw(16, 3))
    norm.load_state_dict(MaskedObservationNorm().state_dict())
    assert (norm.moments[0].count == 0).all()


def test_a_state_of_another_shape_is_refused():
    norm, other = MaskedObservationNorm(), MaskedObservationNorm()
    learn(norm, *draw(16, 3))
    learn(other, *draw(16, 4))
    with pytest.raises(RuntimeError, match="size mismatch"):
        norm.load_state_dict(other.state_dict())
    with pytest.raises(ValueError, match="statistics are those of entries of shape"):
        learn(norm, *draw(16, 5))


def test_a_pickled_transform_goes_on_learning():
    norm = MaskedObservationNorm()
    learn(norm, *draw(16, 3))
    twin = pickle.loads(pickle.dumps(norm))
    learn(twin, *draw(16, 3, seed=1))
    learn(norm, *draw(16, 3, seed=1))
    assert same(state(twin), state(norm))


def test_denormalising_undoes_normalising():
    norm = MaskedObservationNorm(clip=None)
    value, _ = draw(16, 3, missing=0.0)
    scaled = learn(norm, value)["observation"]
    torch.testing.assert_close(norm.denormalize(scaled), value, **TIGHT)
    assert norm.denormalize(scaled.float()).dtype == torch.float32
    with pytest.raises(KeyError, match="`key` must be one of the in_keys"):
        norm.denormalize(scaled, "joints")
    with pytest.raises(RuntimeError, match="no statistics yet"):
        MaskedObservationNorm().denormalize(scaled)


# --------------------------------------------------------------------------------------- refusals
def test_before_a_corrupting_transform_it_is_refused():
    for corrupting in (ObservationMissingness("mcar", 0.5), ObservationNoise(0.1)):
        with pytest.raises(ValueError, match="`MaskedObservationNorm` stands before"):
            TransformedEnv(StaircaseEnv(), Compose(MaskedObservationNorm(), corrupting))


@pytest.mark.slow
def test_learning_in_the_worker_of_a_collector_is_refused():
    def factory():
        return with_transform(gym_env, MaskedObservationNorm)

    with pytest.raises(Exception, match="worker processes of a multi-process"):
        MultiSyncCollector([factory], frames_per_batch=8, total_frames=8)


def test_an_infinite_observed_entry_is_refused_and_not_learned():
    norm = MaskedObservationNorm()
    value, _ = draw(16, 3, missing=0.0)
    learn(norm, value)
    before = state(norm)
    for bad in (float("nan"), float("inf")):
        spoiled = value.clone()
        spoiled[3, 1] = bad
        data = TensorDict(observation=spoiled, batch_size=16)
        with pytest.raises(
            ValueError, match=r"`observation` holds NaN or an infinity.*ObservedFromNaN"
        ):
            norm._step(data.empty(), data)
        assert same(state(norm), before)


@pytest.mark.parametrize("bad", [torch.ones(4, 2), torch.ones(4, 1, dtype=torch.bool)])
def test_a_mask_of_wrong_dtype_or_shape_is_refused(bad):
    data = TensorDict(observation=torch.zeros(4, 2), observed=bad, batch_size=4)
    with pytest.raises(ValueError, match="`observed` must be bool of shape"):
        MaskedObservationNorm()._step(data.empty(), data)


@pytest.mark.parametrize(
    ("bad", "match"),
    [
        ({"clip": 0.0}, "`clip` must be positive"),
        ({"clip": float("nan")}, "`clip` must be positive"),
        ({"eps": 0.0}, "`eps` must be positive"),
        ({"eps": float("inf")}, "`eps` must be positive"),
        ({"out_keys": ["a", "b"]}, "`out_keys` of MaskedObservationNorm"),
        ({"mask_keys": ["a", "b"]}, "`mask_keys` must name one key"),
    ],
)
def test_impossible_settings_are_refused(bad, match):
    with pytest.raises(ValueError, match=match):
        MaskedObservationNorm(**bad)


def test_a_replay_buffer_is_normalised_by_a_frozen_copy_alone():
    norm = MaskedObservationNorm()
    value, _ = draw(16, 3, missing=0.0)
    learn(norm, value)
    data = TensorDict(
        {"observation": value, ("next", "observation"): value + 1, "action": value}, 16
    )

    def sample(transform):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(16), batch_size=8)
        buffer.append_transform(transform)
        buffer.extend(data)
        return buffer.sample()

    with pytest.raises(NotImplementedError, match="frozen_copy"):
        sample(norm.clone())
    frozen = norm.frozen_copy()
    before = state(frozen)
    drawn = sample(frozen)
    raw = data[drawn["index"]]
    expected = (raw["observation"] - norm.loc) / norm.scale
    torch.testing.assert_close(drawn["observation"], expected, **TIGHT)
    expected = (raw["next", "observation"] - norm.loc) / norm.scale
    torch.testing.assert_close(drawn["next", "observation"], expected, **TIGHT)
    assert torch.equal(drawn["action"], raw["action"])
    assert same(state(frozen), before)


def test_frozen_without_statistics_it_refuses_instead_of_passing_raw_values_on():
    """A Collector that wraps the environment clones it: the clone learns, not what it was given."""
    env = TransformedEnv(StaircaseEnv(), MaskedObservationNorm())
    collector = Collector(env, frames_per_batch=6, total_frames=6, max_frames_per_traj=4)
    for _ in collector:
        pass
    assert collector.env is not env
    test = TransformedEnv(StaircaseEnv(), env.transform.frozen_copy())
    with pytest.raises(RuntimeError, match=r"frozen but has no statistics.*`collector\.env`"):
        test.reset()
    norm = next(t for t in collector.env.transform if isinstance(t, MaskedObservationNorm))
    TransformedEnv(StaircaseEnv(), norm.frozen_copy()).reset()


def test_a_default_device_elsewhere_does_not_reach_the_statistics():
    norm, plain = MaskedObservationNorm(), MaskedObservationNorm()
    value, observed = draw(50, 3, dtype=torch.float32)
    with torch.device("meta"):
        learn(norm, value, observed)
    learn(plain, value, observed)
    assert same(state(norm), state(plain))
