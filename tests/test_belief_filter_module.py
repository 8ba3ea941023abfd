"""`BeliefFilterModule`: the requirements of a belief module, its own keys, bad input."""

import functools

import pytest
import torch
from filter_problems import by_hand
from small_agents import make_filter as make_any_filter
from suites import ACTION, OBS, BeliefModuleSuite
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import BeliefFilter, BeliefFilterModule, LinearGaussianEmission, functional

NAMES = ("cov", "observation", "predicted_observation", "innovation_cov")
OPTIONAL = tuple(("belief", name) for name in NAMES)
make_filter = functools.partial(make_any_filter, OBS, ACTION)


def make_frames(shape, dtype=torch.float64, *args, **kwargs):
    return BeliefModuleSuite().make_frames(shape, dtype, *args, **kwargs)


def with_state(frames, state):
    """`frames` with a recurrent state in mid-episode."""
    g = torch.Generator().manual_seed(9)
    shape, dtype = frames.shape, frames["observation"].dtype
    mean = torch.randn(*shape, state, generator=g, dtype=dtype)
    age = torch.full((*shape, 1), 3)
    root = torch.randn(*shape, state, state, generator=g, dtype=dtype)
    cov = root @ root.mT + torch.eye(state)  # read where it is propagated
    recurrent = TensorDict({"mean": mean, "age": age, "cov": cov}, shape)
    return frames.clone().set("recurrent", recurrent)


class TestSuite(BeliefModuleSuite):
    all_outputs = ("features", ("belief", "log_likelihood"), *OPTIONAL)

    filter, policy_input = staticmethod(make_any_filter), "mean"

    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        kwargs = {"policy_input": self.policy_input, **kwargs}
        return BeliefFilterModule(self.filter(obs, action, dtype), **kwargs)

    def differentiable(self, out):
        return out["features"].square().mean() - out["belief", "log_likelihood"].mean()


class Further(TestSuite):
    test_it_runs_in_batched_environments = None  # once is enough


class TestSuiteOfTheInformationForm(Further):
    """State smaller than obs; the covariance in the features."""

    filter, policy_input = staticmethod(functools.partial(make_any_filter, state=3)), "mean_cov"
    test_compiled_without_a_graph_break_equals_eager = None  # the other two do


class TestSuiteOfANetworkCovariance(Further):
    """Q depends on the state: the filter runs step by step."""

    filter = staticmethod(functools.partial(make_any_filter, state=3, cov_network=True))


PROPAGATED = functools.partial(make_any_filter, covariance="propagated")


class TestSuiteOfAPropagatedCovariance(Further):
    """The recurrent state holds the covariance."""

    filter = staticmethod(PROPAGATED)


class TestSuiteOfARobustUpdate(Further):
    """Readings are weighed by the belief of each step; most weights are under 1."""

    filter = staticmethod(functools.partial(PROPAGATED, robust="huber", robust_threshold=0.5))
    test_a_reading_that_is_not_usable_is_named = None  # huge ones are: test_robust_update.py


def test_the_keys_are_those_of_the_design_and_a_list_renames_them_by_position():
    module = BeliefFilterModule(make_filter())
    four = ["observation", "observed", "previous_action", "is_init"]
    assert module.in_keys == [*four, ("recurrent", "mean"), ("recurrent", "age")]
    state = [("next", "recurrent", "mean"), ("next", "recurrent", "age")]
    assert module.out_keys == ["features", ("belief", "mean"), ("belief", "log_likelihood"), *state]
    module = BeliefFilterModule(make_filter(), in_keys=[*four, "f", ("g", "h")])
    assert module.out_keys[-2:] == [("next", "f"), ("next", "g", "h")]
    assert set(module.make_tensordict_primer().primers.keys(True, True)) == {"f", ("g", "h")}


def test_out_keys_as_a_list_or_a_dict_choose_what_is_written_and_computed(monkeypatch):
    data = with_state(make_frames((3,)), OBS)
    make = functools.partial(make_filter, dtype=torch.float64)
    chosen = {"features": ("a", "b"), ("belief", "cov"): "sigma"}
    module = BeliefFilterModule(make(), out_keys=chosen)
    assert module.out_keys[:2] == [("a", "b"), "sigma"]
    out = module(data.clone())
    assert out["a", "b"].shape == (3, OBS)
    assert out["sigma"].shape == (3, OBS, OBS)

    def never(*args, **kwargs):
        raise AssertionError("computed although nobody asked")

    module = BeliefFilterModule(make(), out_keys=["features"])
    monkeypatch.setattr(type(module.filter), "predict", never)
    assert "belief" not in module(data.clone())
    for wrong in ("cov", "", None):
        with pytest.raises(ValueError, match="`policy_input` must be 'mean' or 'mean_cov', got"):
            BeliefFilterModule(make(), policy_input=wrong)


@pytest.mark.parametrize("over_time", [False, True])
@pytest.mark.parametrize(
    ("state", "options"),
    [(OBS, {}), (3, {}), (7, {}), (3, {"cov_network": True}), (3, {"covariance": "propagated"})],
)
def test_optional_entries_equal_the_textbook(state, options, over_time):
    model = make_filter(dtype=torch.float64, state=state, **options)
    module = BeliefFilterModule(model, out_keys=["features", ("belief", "mean"), *OPTIONAL])
    data = with_state(make_frames((3, 6)), state)
    data["is_init"][1, 2] = True
    data["recurrent", "age"][1, 2] = 0
    data["is_init"][2, 4] = True  # an older age: the stored state
    with set_recurrent_mode(over_time):
        out = module(data.clone())

    first = data["is_init"].squeeze(-1)
    mean, cov = data["recurrent", "mean"], data["recurrent", "cov"]
    reset = first & (data["recurrent", "age"].squeeze(-1) == 0) if over_time else first
    stored = first & ~reset if over_time else torch.ones_like(first)
    given = data["previous_action"], data["observation"], data["observed"]
    options = {"use_stored_state": stored, "stored_mean": mean, "stored_cov": cov}
    filtered = by_hand(model, mean[:, 0], cov[:, 0], *given, reset, **options)
    # what each step started from
    begins = (stored | (torch.arange(6) == 0)).unsqueeze(-1)
    before = torch.where(begins, mean, filtered.mean.roll(1, 1))
    before_cov = torch.where(begins.unsqueeze(-1), cov, filtered.cov.roll(1, 1))
    propagated = model.covariance == "propagated"
    moved = model.predict(before, given[0], reset, before_cov if propagated else None)
    emission, action = model.emission, given[0]
    S = functional.innovation(moved, *given[1:], emission.matrix, emission.cov()).cov
    for key, expected in (
        (("belief", "mean"), filtered.mean),
        (("belief", "cov"), filtered.cov),
        (("belief", "observation"), emission(filtered.mean, action)),
        (("belief", "predicted_observation"), emission(moved.mean, action)),
        (("belief", "innovation_cov"), S),
    ):
        torch.testing.assert_close(out[key], expected, rtol=1e-10, atol=1e-10)


def test_an_innovation_covariance_is_that_of_an_emission_with_a_forward_of_its_own():
    class Doubled(LinearGaussianEmission):
        def forward(self, state, previous_action):
            return 2.0 * super().forward(state, previous_action)

    emission = Doubled(OBS, OBS, ACTION, dtype=torch.float64)
    model = BeliefFilter(OBS, ACTION, emission=emission, dtype=torch.float64)
    key = ("belief", "innovation_cov")
    out = BeliefFilterModule(model, out_keys=[key])(with_state(make_frames((3,)), OBS))
    for S, first in zip(out[key], out["is_init"], strict=True):
        P = model.initial_cov if first else model.transition.cov()
        torch.testing.assert_close(S, 4 * P + emission.cov())


def test_an_innovation_covariance_has_the_digits_of_innovation():
    # H P H' is some 1e4 beside an R of 1e-4: float32 would keep nothing of it
    model = make_any_filter(9, ACTION, state=3)
    with torch.no_grad():
        model.emission.matrix *= 30.0
    module = BeliefFilterModule(model, out_keys=[("belief", "innovation_cov")])
    data = with_state(make_frames((4,), obs=9, dtype=torch.float32), 3)
    received = module(data)["belief", "innovation_cov"]
    reset = torch.zeros(4, dtype=torch.bool)
    predicted = model.predict(data["recurrent", "mean"], data["previous_action"], reset)
    x, seen = data["observation"], data["observed"]
    H, R = model.emission.matrix, model.emission.cov()
    expected = functional.innovation(predicted, x, seen, H, R).cov
    assert received.dtype == expected.dtype == torch.float64
    assert torch.equal(received, expected)


def test_mean_cov_features_are_the_mean_and_the_lower_triangle():
    module = BeliefFilterModule(
        make_filter(dtype=torch.float64, state=3),
        policy_input="mean_cov",
        out_keys=["features", ("belief", "mean"), ("belief", "cov")],
    )
    out = module(with_state(make_frames((4,)), 3))
    assert out["features"].shape == (4, module.feature_dim) == (4, 3 + 6)
    row, column = torch.tril_indices(3, 3)
    expected = torch.cat([out["belief", "mean"], out["belief", "cov"][:, row, column]], -1)
    assert torch.equal(out["features"], expected)


def test_autocast_leaves_the_filter_in_its_own_dtype():
    """Half precision would lose the filter's digits; what PyTorch casts are the other networks."""
    written = ["features", ("belief", "log_likelihood"), ("belief", "observation")]
    module = BeliefFilterModule(make_any_filter(9, ACTION), out_keys=written)
    data = make_frames((3, 6), obs=9, dtype=torch.float32)
    data["is_init"][:, 0] = True

    def run(autocast, over_time):
        frames = with_state(data, module.filter.state_dim)[:, slice(None) if over_time else 0]
        with (
            torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast),
            set_recurrent_mode(over_time),
        ):
            out = module(frames)
        return [out[key] for key in written]

    for over_time in (True, False):
        for found, expected in zip(run(True, over_time), run(False, over_time), strict=True):
            assert found.dtype == torch.float32
            assert torch.equal(found, expected)
