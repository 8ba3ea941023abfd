"""PolicyStep: one decision on plain tensors."""

import pytest
import torch
from filter_problems import make_model, sequences
from tensordict import TensorDict
from torch import nn

from torchrl_drbpn import BeliefFilter, BeliefFilterModule, PolicyStep
from torchrl_drbpn.modules import GaussianTransition, LinearGaussianEmission, MaskedObservationNorm

OBS, ACTION, BATCH, TIME = 5, 2, 3, 12


def make(kind, policy_input="mean", dtype=torch.float64, **keys):
    """A belief module of one kind, and a head of one hidden layer."""
    belief = BeliefFilterModule(make_model(kind, dtype), policy_input=policy_input, **keys)
    torch.manual_seed(0)
    layers = nn.Linear(belief.feature_dim, 8, dtype=dtype), nn.Linear(8, ACTION, dtype=dtype)
    return belief, nn.Sequential(layers[0], nn.Tanh(), layers[1])


def first_step(belief):
    observation, observed, is_init = (x[0] for x in inputs())
    action = torch.zeros(BATCH, ACTION, dtype=torch.float64)
    state = PolicyStep(belief, nn.Identity()).initial_state(BATCH)
    return [observation, observed, action, is_init, *state]


def inputs():
    """Per step: observation, mask, first step of an episode; one row restarts in the middle."""
    *_, observation, observed, reset = sequences(OBS, (BATCH,), TIME)
    reset[:, 0] = True
    return *(x.transpose(0, 1) for x in (observation, observed)), reset.T.unsqueeze(-1)


def run(step, belief):
    """Act through the steps; the state is put back to zero where an episode starts."""
    mean, age, *cov = PolicyStep(belief, nn.Identity()).initial_state(BATCH)
    action, out = torch.zeros(BATCH, ACTION, dtype=mean.dtype), []
    for observation, observed, fresh in zip(*inputs(), strict=True):
        mean, age = torch.where(fresh, 0.0, mean), torch.where(fresh, 0, age)
        action = torch.where(fresh, 0.0, action)
        _, mean, age, action, rejected, *cov = step(
            observation, observed, action, fresh, mean, age, *cov
        )
        assert not rejected.any()
        out.append(torch.cat([action, mean], -1))
    return torch.stack(out), age


def through_keys(belief, head, norm=None):
    """A step like that of PolicyStep, by the modules and their keys."""

    @torch.no_grad()
    def step(observation, observed, action, fresh, mean, age, *cov):
        data = TensorDict(
            observation=observation, observed=observed, is_init=fresh, previous_action=action,
            recurrent={"mean": mean, "age": age} | ({"cov": cov[0]} if cov else {}),
            batch_size=[BATCH],
        )  # fmt: skip
        belief(data if norm is None else norm(data))
        after = data["next", "recurrent"]
        cov = [after["cov"]] if cov else []
        return None, after["mean"], after["age"], head(data["features"]), 0 * age, *cov

    return step


@pytest.mark.parametrize("policy_input", ["mean", "mean_cov"])
@pytest.mark.parametrize(
    "kind", ["innovation", "information", "free", "full", "network", "propagated", "row"]
)
def test_a_step_equals_the_tensordict_policy(kind, policy_input):
    belief, head = make(kind, policy_input)
    step = PolicyStep(belief, head)
    assert step.information is (kind == "information")
    assert step.constant is (kind != "network")
    ours, our_age = run(step, belief)
    expected, age = run(through_keys(belief, head), belief)
    torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-10)
    assert torch.equal(our_age, age)


@pytest.mark.parametrize("policy_input", ["mean", "mean_cov"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", ["innovation", "information", "network", "propagated", "row"])
def test_readings_taken_one_by_one_lead_to_the_same_decisions(kind, dtype, policy_input):
    belief, head = make(kind, policy_input, dtype)
    step, sequential = (PolicyStep(belief, head, sequential=by_one) for by_one in (False, True))
    args = [x.to(dtype) if x.is_floating_point() else x for x in first_step(belief)]
    for _ in range(4):
        found, expected = sequential(*args), step(*args)
        for a, b in zip(found, expected, strict=True):
            tolerance = 1e-10 if dtype is torch.float64 else 1e-5
            torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)
        _, mean, age, action, _, *cov = expected
        args[2:] = [action, torch.zeros_like(args[3]), mean, age, *cov]


def test_a_full_noise_covariance_and_a_robust_update_have_no_sequential_form():
    belief, head = make("full")
    with pytest.raises(ValueError, match="`sequential` needs a diagonal emission covariance"):
        PolicyStep(belief, head, sequential=True)
    belief, head = make("innovation")
    belief.filter.robust = "huber"
    with pytest.raises(ValueError, match=r"`sequential` needs .* `robust` None"):
        PolicyStep(belief, head, sequential=True)


@pytest.mark.parametrize(
    ("obs", "state", "cov"),
    [(27, 8, "full"), (105, 16, "full"), (105, 16, "diag"), (17, 17, "diag")],
)
def test_a_float32_step_has_the_digits_of_the_float32_module(obs, state, cov):
    """R std .01 and an H of low rank: a factorisation in float32 would lose most of them."""
    g = torch.Generator().manual_seed(0)
    emission = LinearGaussianEmission(obs, state, ACTION, cov=cov, init_std=0.011)
    rank = min(obs, state) // 2
    with torch.no_grad():
        emission.matrix.copy_(
            torch.randn(obs, rank, generator=g) @ torch.randn(rank, state, generator=g)
        )
    transition = GaussianTransition(state, ACTION, init_std=1.0)
    belief = BeliefFilter(obs, ACTION, state, transition=transition, emission=emission)
    step = PolicyStep(BeliefFilterModule(belief), nn.Identity())
    rows = 64
    reading = torch.randn(rows, state, generator=g) @ emission.matrix.detach().mT
    reading += 0.01 * torch.randn(rows, obs, generator=g)
    seen = torch.rand(rows, obs, generator=g) < 0.7
    action, mean = torch.zeros(rows, ACTION), torch.randn(rows, state, generator=g)
    first = torch.zeros(rows, 1, dtype=torch.bool)
    with torch.no_grad():
        found = step(reading, seen, action, first, mean, torch.ones(rows, 1).long())[1]
        expected = belief.step(mean, None, action, reading, seen, first.squeeze(-1)).mean
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("kind", ["innovation", "information", "network", "propagated", "row"])
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch_shape_is_taken_and_the_module_may_be_cast(kind, batch):
    belief, head = make(kind)
    step = PolicyStep(belief, head)
    rows = [x.expand(2, *x.shape).flatten(0, 1) for x in first_step(belief)]  # six
    rows[3], rows[4] = torch.zeros_like(rows[3]), torch.randn_like(rows[4])
    rows = [x[: torch.Size(batch).numel()] for x in rows]
    action, mean = step(*(x.reshape(*batch, *x.shape[1:]) for x in rows))[:2]
    expected = step(*rows)
    torch.testing.assert_close(action.reshape(-1, ACTION), expected[0])
    torch.testing.assert_close(mean.reshape(expected[1].shape), expected[1])
    step.float()
    assert step.initial_state(2)[0].dtype == torch.float32
    narrow = [x.float() if x.is_floating_point() else x for x in rows]
    torch.testing.assert_close(step(*narrow)[1].double(), expected[1], rtol=1e-4, atol=1e-4)


def test_a_normalised_policy_is_one_step_with_its_statistics():
    belief, head = make("innovation", in_key="normalized_observation")
    norm, (observation, observed, _) = MaskedObservationNorm(OBS), inputs()
    rollout = TensorDict(observation=3 * observation + 5, observed=observed)
    rollout.batch_size = [TIME, BATCH]
    norm.update(rollout)
    step = PolicyStep(belief, head, norm=norm)
    expected, _ = run(through_keys(belief, head, norm), belief)
    assert not torch.allclose(run(PolicyStep(belief, head), belief)[0], expected)
    # a frozen copy: what is learned afterwards does not reach it
    norm.update(rollout)
    with torch.no_grad():
        for parameter in (*belief.parameters(), *head.parameters()):
            parameter += 0.1
    other = PolicyStep(belief, head, norm=norm)
    torch.testing.assert_close(run(step, belief)[0], expected, rtol=1e-9, atol=1e-10)
    assert not any(p.requires_grad for p in step.parameters())
    other.load_state_dict(step.state_dict())
    assert torch.equal(run(other, belief)[0], run(step, belief)[0])


@pytest.mark.parametrize("normed", [False, True])
@pytest.mark.parametrize("junk", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("kind", ["innovation", "information", "network"])
def test_a_reading_that_is_not_finite_counts_as_missing_and_is_counted(kind, junk, normed):
    belief, head = make(kind)
    norm = MaskedObservationNorm(OBS) if normed else None
    step = PolicyStep(belief, head, norm=norm)
    observation, observed, *rest = first_step(belief)
    *clean, none = step(observation, observed, *rest)
    assert not none.any()
    spoilt = step(torch.where(observed, observation, junk), torch.ones_like(observed), *rest)
    for a, b in zip(clean, spoilt, strict=False):
        assert torch.equal(a, b)
    assert torch.equal(spoilt[-1], (~observed).sum(-1, keepdim=True))


def test_limits_clip_the_action_and_not_what_is_fed_back():
    belief, head = make("innovation")

    class LocScale(nn.Module):
        def __init__(self):
            super().__init__()
            self.location = head

        def forward(self, features):
            return self.location(features), torch.ones(2)

    high = torch.full((ACTION,), 0.05, dtype=torch.float64)
    limited = PolicyStep(belief, LocScale(), action_low=-high, action_high=high)
    action = PolicyStep(belief, head)(*first_step(belief))[0]
    clipped, _, _, chosen, _ = limited(*first_step(belief))
    assert action.abs().max() > 0.05
    assert torch.equal(clipped, action.clamp(-0.05, 0.05))
    assert torch.equal(chosen, action)
    # the belief of an episode is that of the policy that was trained, which knows no limits
    torch.testing.assert_close(run(limited, belief)[0], run(through_keys(belief, head), belief)[0])
    with pytest.raises(ValueError, match="given together"):
        PolicyStep(belief, head, action_low=-high)
    with pytest.raises(TypeError, match="`belief` must be a BeliefFilterModule"):
        PolicyStep(head, head)


def test_a_missing_covariance_is_named():
    belief, head = make("propagated")
    with pytest.raises(ValueError, match=r"`cov` must have shape \(3, 5, 5\) here.*got None"):
        PolicyStep(belief, head)(*first_step(belief)[:6])


@pytest.mark.parametrize(("place", "width"), [(0, 1), (1, 1), (2, 1), (3, ACTION), (4, 1), (5, 2)])
def test_a_tensor_of_another_width_or_batch_is_refused_and_not_broadcast(place, width):
    belief, head = make("innovation")
    step, args = PolicyStep(belief, head), first_step(belief)
    wide = args[place][:, :1].expand(BATCH, width)
    for wrong in (wide, wide[:1]):
        args[place] = wrong
        with pytest.raises(ValueError, match=r"must be .* of shape \(\*batch, \d\)"):
            step(*args)


@pytest.mark.parametrize(
    ("kind", "robust"),
    [("innovation", None), ("information", None), ("network", None), ("propagated", None),
     ("innovation", "huber"), ("information", "imq")],
)  # fmt: skip
def test_export_takes_it_with_any_batch(kind, robust):
    belief, head = make(kind)
    belief.filter.robust = robust
    limit = torch.full((ACTION,), 0.05, dtype=torch.float64)
    norm = MaskedObservationNorm(OBS)
    step = PolicyStep(belief, head, norm=norm, action_low=-limit, action_high=limit)
    args = tuple(first_step(belief))
    args[0][0, 0] = torch.nan
    batch = torch.export.Dim("batch", min=1, max=1024)
    exported = torch.export.export(step, args, dynamic_shapes=tuple({0: batch} for _ in args))
    for size in (BATCH, OBS, 7):
        rows = [torch.cat([x, x, x])[:size] for x in args]
        for a, b in zip(exported.module()(*rows), step(*rows), strict=True):
            torch.testing.assert_close(a, b)
