"""PolicyStep: one decision on plain tensors."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_drbpn import (
    BeliefFilter,
    BeliefFilterModule,
    GaussianTransition,
    LinearGaussianEmission,
    PolicyStep,
)
from torchrl_drbpn.modules import MaskedObservationNorm

ACTION, BATCH, TIME = 2, 3, 12


def perturbed(module: nn.Module) -> nn.Module:
    """Move every parameter away from where it starts."""
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in module.parameters():
            p += 0.1 * torch.randn(p.shape, generator=g, dtype=p.dtype)
    return module


def make(kind: str, policy_input: str = "mean", dtype: torch.dtype = torch.float64, **keys):
    """A belief module of one kind, and a head of one hidden layer."""
    obs, state = {"information": (9, 4), "free": (3, 4)}.get(kind, (4, 4))
    transition, emission = None, None
    if kind == "network":
        transition = GaussianTransition(state, ACTION, cov_network=True, dtype=dtype)
    if kind == "full":
        transition = GaussianTransition(state, ACTION, cov="full", activation="tanh", dtype=dtype)
        emission = LinearGaussianEmission(obs, state, ACTION, cov="full", dtype=dtype)
    torch.manual_seed(0)
    options = {"transition": transition, "emission": emission, "dtype": dtype}
    if kind in ("propagated", "row"):
        options |= {"covariance": "propagated", "jacobian": "row" if kind == "row" else "mean"}
    belief = BeliefFilterModule(
        BeliefFilter(obs, ACTION, state, **options),
        policy_input=policy_input,
        **keys,
    )
    layers = nn.Linear(belief.feature_dim, 8, dtype=dtype), nn.Linear(8, ACTION, dtype=dtype)
    return perturbed(belief), perturbed(nn.Sequential(layers[0], nn.Tanh(), layers[1]))


def first_step(belief: BeliefFilterModule):
    """The arguments of a PolicyStep at the first step of an episode."""
    observation, observed, is_init = (x[0] for x in inputs(belief.filter.obs_dim))
    action = torch.zeros(BATCH, ACTION, dtype=torch.float64)
    state = PolicyStep(belief, nn.Identity()).initial_state(BATCH)
    return [observation, observed, action, is_init, *state]


def inputs(obs: int, dtype: torch.dtype = torch.float64, seed: int = 0):
    """Per step: observation, mask, first step of an episode; one row restarts in the middle."""
    g = torch.Generator().manual_seed(seed)
    observation = torch.randn(TIME, BATCH, obs, generator=g, dtype=dtype)
    observed = torch.rand(TIME, BATCH, obs, generator=g) > 0.4
    observed[3] = False
    is_init = torch.zeros(TIME, BATCH, 1, dtype=torch.bool)
    is_init[0] = True
    is_init[6, 1] = True
    return observation, observed, is_init


def run_step(step: PolicyStep, obs: int):
    """Act through the steps; the state is put back to zero where an episode starts."""
    observation, observed, is_init = inputs(obs)
    mean, age, *cov = step.initial_state(BATCH)
    action = torch.zeros(BATCH, ACTION, dtype=mean.dtype)
    out = []
    for t in range(TIME):
        fresh = is_init[t]
        mean, age = torch.where(fresh, 0.0, mean), torch.where(fresh, 0, age)
        action = torch.where(fresh, 0.0, action)
        given = (observation[t], observed[t], action, fresh, mean, age, *cov)
        _, mean, age, action, rejected, *cov = step(*given)
        assert not rejected.any()
        out.append(torch.cat([action, mean], -1))
    return torch.stack(out), age


def run_module(belief: BeliefFilterModule, head: nn.Module, norm: nn.Module | None = None):
    """The same through keys."""
    observation, observed, is_init = inputs(belief.filter.obs_dim)
    mean, age, *cov = PolicyStep(belief, nn.Identity()).initial_state(BATCH)
    action = torch.zeros(BATCH, ACTION, dtype=torch.float64)
    out = []
    for t in range(TIME):
        fresh = is_init[t]
        mean, age = torch.where(fresh, 0.0, mean), torch.where(fresh, 0, age)
        data = TensorDict(
            observation=observation[t], observed=observed[t], is_init=fresh,
            previous_action=torch.where(fresh, 0.0, action), recurrent={"mean": mean, "age": age},
            batch_size=[BATCH],
        )  # fmt: skip
        if cov:
            data["recurrent", "cov"] = cov[0]
        with torch.no_grad():
            belief(data if norm is None else norm(data))
            action = head(data["features"])
        mean, age = data["next", "recurrent", "mean"], data["next", "recurrent", "age"]
        cov = [data["next", "recurrent", "cov"]] if cov else []
        out.append(torch.cat([action, mean], -1))
    return torch.stack(out), age


@pytest.mark.parametrize("policy_input", ["mean", "mean_cov"])
@pytest.mark.parametrize(
    "kind", ["innovation", "information", "free", "full", "network", "propagated", "row"]
)
def test_a_step_equals_the_tensordict_policy(kind, policy_input):
    belief, head = make(kind, policy_input)
    step = PolicyStep(belief, head)
    assert step.information is (kind == "information")
    assert step.constant is (kind != "network")
    ours, our_age = run_step(step, belief.filter.obs_dim)
    expected, age = run_module(belief, head)
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
    norm, (observation, observed, _) = MaskedObservationNorm(4), inputs(4)
    rollout = TensorDict(observation=3 * observation + 5, observed=observed)
    rollout.batch_size = [TIME, BATCH]
    norm.update(rollout)
    step = PolicyStep(belief, head, norm=norm)
    expected, _ = run_module(belief, head, norm)
    assert not torch.allclose(run_step(PolicyStep(belief, head), 4)[0], expected)
    # a frozen copy: what is learned afterwards does not reach it
    norm.update(rollout)
    other = PolicyStep(perturbed(belief), perturbed(head), norm=norm)
    torch.testing.assert_close(run_step(step, 4)[0], expected, rtol=1e-9, atol=1e-10)
    assert not any(p.requires_grad for p in step.parameters())
    other.load_state_dict(step.state_dict())
    assert torch.equal(run_step(other, 4)[0], run_step(step, 4)[0])


@pytest.mark.parametrize("normed", [False, True])
@pytest.mark.parametrize("junk", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("kind", ["innovation", "information", "network"])
def test_a_reading_that_is_not_finite_counts_as_missing_and_is_counted(kind, junk, normed):
    belief, head = make(kind)
    norm = MaskedObservationNorm(belief.filter.obs_dim) if normed else None
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
        def __init__(self) -> None:
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
    torch.testing.assert_close(run_step(limited, 4)[0], run_module(belief, head)[0])
    with pytest.raises(ValueError, match="given together"):
        PolicyStep(belief, head, action_low=-high)
    with pytest.raises(TypeError, match="`belief` must be a BeliefFilterModule"):
        PolicyStep(head, head)


def test_a_missing_covariance_is_named():
    belief, head = make("propagated")
    with pytest.raises(ValueError, match=r"`cov` must have shape \(3, 4, 4\) here.*got None"):
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


@pytest.mark.parametrize("kind", ["innovation", "information", "network", "propagated"])
def test_export_takes_it_with_any_batch(kind):
    belief, head = make(kind)
    limit = torch.full((ACTION,), 0.05, dtype=torch.float64)
    norm = MaskedObservationNorm(belief.filter.obs_dim)
    step = PolicyStep(belief, head, norm=norm, action_low=-limit, action_high=limit)
    args = tuple(first_step(belief))
    args[0][0, 0] = torch.nan
    batch = torch.export.Dim("batch", min=1, max=1024)
    exported = torch.export.export(step, args, dynamic_shapes=tuple({0: batch} for _ in args))
    for size in (BATCH, 7):
        rows = [torch.cat([x, x, x])[:size] for x in args]
        for a, b in zip(exported.module()(*rows), step(*rows), strict=True):
            torch.testing.assert_close(a, b)
