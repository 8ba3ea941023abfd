"""What `MaskedObservationNorm` is held to: statistics that are the agent's."""

import copy
import functools

import pytest
import torch
from refusals import refuses
from suites import saved
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import Compose, InitTracker, TransformedEnv

from torchrl_drbpn import GymnasiumBatchEnv, MaskedObservationNorm, ObservationMissingness

OBS = 3
DOUBLE = torch.float64


def make_rollout(seed=0, batch=(4,), time=25, missing=0.3):
    """Draw readings in order; an episode ends after 10 steps, its last reading is a next one."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, time, OBS)

    def readings():
        x = torch.randn(shape, generator=generator, dtype=DOUBLE) * torch.arange(1, OBS + 1)
        seen = torch.rand(shape, generator=generator) >= missing
        return (x + 10 * torch.arange(OBS)).where(seen, 0.0), seen

    (x, seen), (last, last_seen) = readings(), readings()
    done = torch.zeros(*batch, time, 1, dtype=torch.bool)
    done[..., 9, :] = True
    is_init = torch.zeros_like(done)
    is_init[..., 0, :] = is_init[..., 10, :] = True
    # Between ends of episodes the next reading is that of the next step.
    ends = done.clone()
    ends[..., -1, :] = True
    following = {"observation": last.where(ends, x.roll(-1, -2)), "done": done}
    following["observed"] = last_seen.where(ends, seen.roll(-1, -2))
    data = {"observation": x, "observed": seen, "is_init": is_init, "next": following}
    return TensorDict(data, (*batch, time))


def received(rollout, component):
    """Return the readings of a sensor that arrived, each once, by plain loops."""
    out = []
    for row in rollout.reshape(-1, rollout.shape[-1]):
        for step in row:
            out += [step] + ([step["next"]] if step["next", "done"] else [])
        if not row[-1]["next", "done"]:
            out.append(row[-1]["next"])
    return torch.stack([s["observation"][component] for s in out if s["observed"][component]])


def learned(*rollouts, **kwargs):
    norm = MaskedObservationNorm(OBS, **kwargs)
    for rollout in rollouts:
        norm.update(rollout)
    return norm


def state(norm):
    return [norm.count.double(), norm.mean, norm.var]


def assert_same_state(first, second):
    for a, b in zip(state(first), state(second), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


def test_every_reading_that_arrived_is_learned_from_once():
    rollout = make_rollout()
    norm = learned(rollout)
    for i in range(OBS):
        x = received(rollout, i)
        assert norm.count[i] == len(x)
        torch.testing.assert_close(norm.mean[i], x.mean())
        torch.testing.assert_close(norm.std[i], (x.var(correction=0) + norm.eps).sqrt())


def test_however_a_rollout_is_cut_the_same_is_learned():
    # long enough a first part that both bound wild readings alike: by nothing
    rollout = make_rollout(batch=(2, 25), time=24)
    norm = learned(rollout)
    assert_same_state(norm, learned(*rollout.split(12, 2)))
    for sequences in (rollout.reshape(50, 24), rollout.reshape(-1, 6)):
        assert_same_state(norm, learned(sequences))
    assert_same_state(learned(rollout[0, 0]), learned(rollout[0, :1]))


def test_without_next_the_steps_alone_count_and_without_a_mask_all_arrived():
    rollout = make_rollout().exclude("next", "is_init")
    assert torch.equal(learned(rollout).count, rollout["observed"].sum((0, 1)))
    rollout = make_rollout(missing=0.0)
    norm = learned(rollout.exclude("observed", ("next", "observed")), in_keys=["observation"])
    assert_same_state(norm, learned(rollout))


def test_what_did_not_arrive_may_hold_anything():
    rollout = make_rollout()
    wild = rollout.clone()
    for part in (wild, wild["next"]):
        part["observation"].masked_fill_(~part["observed"], torch.nan)
    norm, other = learned(rollout), learned(wild)
    assert_same_state(norm, other)
    key = "normalized_observation"
    assert torch.equal(norm(rollout.clone())[key], norm(wild)[key])


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_reading_that_is_no_number_is_refused_and_not_learned(bad):
    norm, rollout = learned(make_rollout()), make_rollout(1)
    before = copy.deepcopy(norm)
    rollout["observation"][0, 3, 1] = bad
    rollout["observed"][0, 3, 1] = True
    with pytest.raises(
        ValueError, match=r"`observation` holds NaN or an infinity.*ObservedFromNaN"
    ):
        norm.update(rollout)
    assert_same_state(norm, before)


@pytest.mark.parametrize("wild", [1e5, -1e5, 1e160, 1.7e308])
@pytest.mark.parametrize("first", [True, False], ids=["first", "later"])
@pytest.mark.parametrize("rows", [1, 100], ids=["of 200", "of 20,000"])
def test_one_wild_reading_undoes_no_sensor(wild, first, rows):
    clean = make_rollout(batch=(rows,), time=200, missing=0.0)
    spoilt = clean.clone()
    spoilt["observation"][0, 50, 1] = wild
    rollouts = (spoilt,) if first else (clean, spoilt)
    norm, expected = learned(*rollouts), learned(*[clean] * len(rollouts))
    few = rows == 1
    torch.testing.assert_close(norm.std, expected.std, rtol=0.6 if few else 0.05, atol=0)
    torch.testing.assert_close(norm.mean, expected.mean, rtol=0, atol=0.6 if few else 0.02)


def test_in_float32_nothing_overflows():
    rollout = make_rollout(missing=0.0).apply(lambda x: x.float() if x.is_floating_point() else x)
    rollout["observation"] *= 1e10
    rollout["next", "observation"] *= 1e10
    norm = MaskedObservationNorm(OBS, dtype=torch.float32)
    for _ in range(3):
        norm.update(rollout)
    norm.count.fill_(10**12)  # a run of years
    norm.update(rollout)
    assert norm.count.gt(10**12).all()
    exact = learned(rollout)
    torch.testing.assert_close(norm.std.double(), exact.std, rtol=1e-4, atol=0)
    rollout["observation"] *= 1e20  # squared more than a float32 holds
    norm.update(rollout)
    assert norm.var.isfinite().all()
    assert norm(rollout)["normalized_observation"].isfinite().all()


def test_what_arrived_is_standardised_and_the_rest_is_zero():
    rollout = make_rollout()
    norm, x = learned(rollout), rollout["observation"]
    expected = ((x - norm.mean) / norm.std).where(rollout["observed"], 0.0)
    torch.testing.assert_close(norm(rollout)["normalized_observation"], expected)
    norm = learned(rollout, clip=None)
    torch.testing.assert_close(norm.denormalize(norm.normalize(x)), x)


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_before_it_has_learned_it_is_the_identity_up_to_the_clip(dtype):
    x = torch.tensor([0.3, -7.0, 1e30], dtype=dtype)
    out = MaskedObservationNorm(OBS)(TensorDict(observation=x, observed=torch.ones(OBS).bool()))
    expected = torch.tensor([0.3, -7.0, 10.0], dtype=dtype)
    torch.testing.assert_close(out["normalized_observation"], expected, rtol=0, atol=0)


@pytest.mark.parametrize("shape", [(), (2,), (2, 5), (2, 3, 4)])
def test_any_leading_dimensions_are_scaled_and_nothing_is_changed(shape):
    norm = learned(make_rollout())
    data = TensorDict(
        observation=torch.randn(*shape, OBS), observed=torch.rand(*shape, OBS) < 0.5,
        batch_size=shape,
    )  # fmt: skip
    before, statistics = data.clone(), copy.deepcopy(norm)
    out = norm(data)
    assert out["normalized_observation"].shape == (*shape, OBS)
    for key in before.keys(True):
        assert torch.equal(data[key], before[key])
    assert_same_state(norm, statistics)
    torch.testing.assert_close(norm(**before), out["normalized_observation"])


def test_what_was_filled_is_standardised_and_what_was_never_seen_reads_zero():
    norm = learned(make_rollout(), missing="keep")
    x = torch.tensor([5.0, 6.0, torch.nan])
    out = norm(TensorDict(observation=x, observed=torch.tensor([True, False, False])))
    z = out["normalized_observation"]
    torch.testing.assert_close(z[:2].double(), (x.double() - norm.mean)[:2] / norm.std[:2])
    assert z[2] == 0


def test_a_complete_observation_is_scaled_alike_and_not_learned_from():
    keys = ("complete_observation", "normalized_complete")
    rollout = make_rollout()
    norm = learned(rollout.clone().set(keys[0], torch.full((4, 25, OBS), 1e3)), complete_keys=keys)
    assert_same_state(norm, learned(rollout))
    rollout[keys[0]] = rollout["observation"]
    out = norm(rollout)
    torch.testing.assert_close(out[keys[1]], norm.normalize(rollout["observation"]))
    assert norm(make_rollout()).get(keys[1], None) is None


def make_policy(norm, width=OBS):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        head = TensorDictModule(
            torch.nn.Linear(width, 1), in_keys=["normalized_observation"], out_keys=["action"]
        )
    return TensorDictSequential(norm, head)


def test_the_state_survives_a_file_read_without_running_code():
    norm, other = learned(make_rollout()), MaskedObservationNorm(OBS)
    make_policy(other).load_state_dict(saved(make_policy(norm).state_dict()))
    assert_same_state(norm, other)


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("var", torch.tensor([1.0, -1, 1]), r"`module\.0\.var` holds -1\.0: that is no statistic"),
        ("var", torch.tensor([1.0, torch.inf, 1]), r"0\.var` holds inf"),
        ("mean", torch.tensor([-1.0, torch.nan, 1]), r"0\.mean` holds nan"),
        ("count", torch.tensor([1, -1, 1]), r"0\.count` holds -1"),
    ],
)  # fmt: skip
def test_statistics_that_are_none_are_refused_at_load(name, value, match):
    state = make_policy(learned(make_rollout())).state_dict()
    with pytest.raises(ValueError, match=match):
        make_policy(MaskedObservationNorm(OBS)).load_state_dict(
            {**state, f"module.0.{name}": value}
        )


def test_compiled_without_a_break_it_is_the_same_and_sees_an_update_and_it_is_exported():
    policy = make_policy(learned(make_rollout())).double()
    compiled = torch.compile(policy, fullgraph=True, backend="eager")
    for seed in (1, 2):
        data = make_rollout(seed).select("observation", "observed")
        expected = policy(data.clone())["action"]
        assert torch.equal(compiled(data.clone())["action"], expected)
        exported = torch.export.export(policy, args=(), kwargs={**data}, strict=False).module()
        torch.testing.assert_close(exported(**data)[-1], expected)
        policy[0].update(make_rollout(seed + 5))


def make_env():
    base = GymnasiumBatchEnv("InvertedPendulum-v5", 2, seed=0, max_episode_steps=9)
    return TransformedEnv(base, Compose(ObservationMissingness("mcar", 0.5), InitTracker()))


@pytest.mark.slow
def test_a_collector_in_another_process_is_sent_the_statistics():
    norm = MaskedObservationNorm(4)
    policy = make_policy(norm, 4)
    collector = MultiSyncCollector(
        [make_env], policy, frames_per_batch=50, total_frames=150, cat_results=0
    )
    for index, data in enumerate(collector):
        if index:
            expected = norm.normalize(data["observation"], data["observed"])
            torch.testing.assert_close(data["normalized_observation"], expected)
        norm.update(data)
        collector.update_policy_weights_()
    collector.shutdown()


def test_nested_keys_are_taken_as_configurations_write_them():
    agents = [["agents", "observation"], ["agents", "observed"]]
    out = [["agents", "normalized"]]
    norm, plain = MaskedObservationNorm(OBS, in_keys=agents, out_keys=out), make_rollout()
    data = plain.empty().set("agents", plain.select("observation", "observed"))
    expected = MaskedObservationNorm(OBS)(plain)["normalized_observation"]
    assert torch.equal(norm(data)["agents", "normalized"], expected)
    data["agents", "observed"] = torch.ones(4, 25, 1)
    with pytest.raises(ValueError, match=r"`\('agents', 'observed'\)` must be bool"):
        norm(data)


test_impossible_settings_are_refused = refuses(
    ({"obs_dim": 0}, "`obs_dim` must"),
    ({"clip": -1.0}, "`clip` must"),
    ({"eps": 0.0}, "`eps` must"),
    ({"missing": "drop"}, "`missing` must"),
    ({"in_keys": ["a", "b", "c"]}, "`in_keys` must name"),
    ({"in_keys": ["a", None]}, "`in_keys` must name"),
    ({"out_keys": ["observation"]}, "`out_keys` must differ"),
    make=functools.partial(MaskedObservationNorm, obs_dim=OBS),
)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("observation", torch.zeros(4, 25, 5)),
        ("observed", torch.ones(4, 25, 1).bool()),
        ("observed", torch.ones(4, 25, OBS)),
        ("observation", None),
        ("observed", None),
    ],
)
def test_entries_that_are_absent_or_of_another_shape_or_dtype_are_refused(name, value):
    norm, data = MaskedObservationNorm(OBS), make_rollout().exclude(name)
    if value is not None:
        data[name] = value
    for call in (norm, norm.update):
        with pytest.raises((ValueError, KeyError), match=f"`{name}` (must|is not in the tensordi)"):
            call(data)
