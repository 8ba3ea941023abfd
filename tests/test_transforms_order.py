"""Which orders of transforms are refused, however the chain is put together.

A normaliser before a corrupting transform, a filler before missingness, two writers of the complete
observation, and a complete observation recorded after the first corruption are errors: in a
`Compose`, nested or not, at the construction of an environment, at `append_transform` and
`insert_transform`, and across environments wrapped twice. Inside workers the specs tell.
"""

from __future__ import annotations

from functools import partial

import pytest
import torch
from contracts import (
    OBS,
    StaircaseEnv,
    gym_env,
)
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    RewardSum,
    SerialEnv,
    TransformedEnv,
)

from torchrl_drbpn.transforms import (
    FillLastObserved,
    MaskedObservationNorm,
    ObservationMissingness,
    ObservationNoise,
    ObservedFromNaN,
    SensorReduction,
)

COMPLETE = "complete_observation"


def staircase(*transforms, **kwargs):
    return TransformedEnv(StaircaseEnv(**kwargs), Compose(*transforms))


def data(value=1.0, batch=(4,), **more):
    return TensorDict({"observation": torch.full((*batch, OBS), value), **more}, batch)


def corrupted_gym():
    return gym_env("InvertedPendulum-v5").append_transform(
        Compose(
            ObservationNoise(0.1, complete_key=COMPLETE),
            ObservationMissingness("nmar", 0.9),
        )
    )


NORM, FILL = MaskedObservationNorm, FillLastObserved
NOISE = partial(ObservationNoise, 0.1)
MISSING = partial(ObservationMissingness, "mcar", 0.5)
REDUCED = partial(SensorReduction, [0])
WRONG = [
    ([NORM, NOISE], "`MaskedObservationNorm` stands before `ObservationNoise`"),
    ([NORM, MISSING], "`MaskedObservationNorm` stands before `ObservationMissingness`"),
    ([NORM, REDUCED], "`MaskedObservationNorm` stands before `SensorReduction`"),
    ([NORM, ObservedFromNaN], "`MaskedObservationNorm` stands before `ObservedFromNaN`"),
    ([FILL, MISSING], "`FillLastObserved` stands before `ObservationMissingness`"),
    ([FILL, ObservedFromNaN], "`FillLastObserved` stands before `ObservedFromNaN`"),
    (
        [partial(NOISE, complete_key=COMPLETE), partial(MISSING, complete_key=COMPLETE)],
        "`complete_observation` is written by two transforms",
    ),
    ([NOISE, partial(MISSING, complete_key=COMPLETE)], "has corrupted the observation before it"),
]
WRONG_IDS = [f"{i}" for i in range(len(WRONG))]


def in_compose(first, second):
    return Compose(first, RewardSum(), second)


def in_nested_compose(first, second):
    return Compose(Compose(first, RewardSum()), Compose(second))


def in_environment(first, second):
    return TransformedEnv(StaircaseEnv(), Compose(first, second))


def appended(first, second):
    return TransformedEnv(StaircaseEnv(), first).append_transform(second)


def inserted(first, second):
    return staircase(RewardSum(), second).insert_transform(0, first)


def wrapped_twice(first, second):
    inner = TransformedEnv(StaircaseEnv(), first)
    return TransformedEnv(inner, second, auto_unwrap=False)


@pytest.mark.parametrize(("chain", "message"), WRONG, ids=WRONG_IDS)
@pytest.mark.parametrize(
    "put_together",
    [in_compose, in_nested_compose, in_environment, appended, inserted, wrapped_twice],
)
def test_a_wrong_order_is_refused_however_it_comes_about(chain, message, put_together):
    first, second = (make() for make in chain)
    with pytest.raises(ValueError, match=message):
        put_together(first, second)


def test_an_environment_is_left_as_it_was_by_what_it_refuses():
    env = staircase(MaskedObservationNorm())
    with pytest.raises(ValueError, match="stands before"):
        env.append_transform(MISSING())
    assert [type(part) for part in env.transform] == [MaskedObservationNorm]
    assert env.rollout(2).get("observed", None) is None
    env.insert_transform(0, MISSING())
    assert env.rollout(2).get("observed", None) is not None


def test_the_order_of_the_recipe_is_accepted_and_other_keys_do_not_matter():
    noise = partial(NOISE, complete_key=COMPLETE)
    recipe = staircase(noise(), MISSING(), NORM())
    filled = staircase(ObservedFromNaN(), noise(), MISSING(), FILL(), NORM())
    for env in (recipe, filled):
        assert {"observation", "observed", COMPLETE} <= set(env.rollout(2).keys())
    assert len(staircase(NORM(in_keys=["other"]), MISSING()).transform) == 2


def test_a_writer_inside_the_workers_is_found_through_the_specs():
    env = TransformedEnv(SerialEnv(2, corrupted_gym), MISSING(complete_key=COMPLETE))
    with pytest.raises(ValueError, match="is among the observations of the environment already"):
        env.reset()
    env.close()
