"""PolicyStep: one decision on plain tensors.

Specified here: over whole episodes, resets and missing entries included, its action and its state
are those of the TensorDict policy acting with its mean, in every form of the filter; it is a frozen
copy; torch.export takes it, with a batch of any size, and gives the same numbers.
"""

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

ACTION, BATCH, TIME = 2, 3, 12


def perturbed(module: nn.Module) -> nn.Module:
    """Move every parameter away from where it starts."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in module.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
            parameter += 0.1 * noise
    return module


def make(kind: str, policy_input: str = "mean", dtype: torch.dtype = torch.float64):
    """A belief module of one kind, and a head of one hidden layer."""
    obs, state = {"information": (9, 4), "free": (3, 4)}.get(kind, (4, 4))
    transition, emission = None, None
    if kind == "network":
        transition = GaussianTransition(state, ACTION, cov_network=True, dtype=dtype)
    if kind == "full":
        transition = GaussianTransition(state, ACTION, cov="full", activation="tanh", dtype=dtype)
        emission = LinearGaussianEmission(obs, state, ACTION, cov="full", dtype=dtype)
    torch.manual_seed(0)
    belief = BeliefFilterModule(
        BeliefFilter(obs, ACTION, state, transition=transition, emission=emission, dtype=dtype),
        policy_input=policy_input,
    )
    head = nn.Sequential(
        nn.Linear(belief.feature_dim, 8, dtype=dtype),
        nn.Tanh(),
        nn.Linear(8, ACTION, dtype=dtype),
    )
    return perturbed(belief), perturbed(head)


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
    mean, age = step.initial_state(BATCH)
    action = torch.zeros(BATCH, ACTION, dtype=mean.dtype)
    out = []
    for t in range(TIME):
        fresh = is_init[t]
        mean, age = torch.where(fresh, 0.0, mean), torch.where(fresh, 0, age)
        action = torch.where(fresh, 0.0, action)
        action, mean, age = step(observation[t], observed[t], action, fresh, mean, age)
        out.append(torch.cat([action, mean], -1))
    return torch.stack(out), age


def run_module(belief: BeliefFilterModule, head: nn.Module):
    """The same through keys."""
    observation, observed, is_init = inputs(belief.filter.obs_dim)
    mean = torch.zeros(BATCH, belief.filter.state_dim, dtype=torch.float64)
    age = torch.zeros(BATCH, 1, dtype=torch.int64)
    action = torch.zeros(BATCH, ACTION, dtype=torch.float64)
    out = []
    for t in range(TIME):
        fresh = is_init[t]
        data = TensorDict(
            {
                "observation": observation[t],
                "observed": observed[t],
                "previous_action": torch.where(fresh, 0.0, action),
                "is_init": fresh,
                "recurrent": {
                    "mean": torch.where(fresh, 0.0, mean),
                    "age": torch.where(fresh, 0, age),
                },
            },
            batch_size=[BATCH],
        )
        with torch.no_grad():
            belief(data)
            action = head(data["features"])
        mean, age = data["next", "recurrent", "mean"], data["next", "recurrent", "age"]
        out.append(torch.cat([action, mean], -1))
    return torch.stack(out), age


@pytest.mark.parametrize("policy_input", ["mean", "mean_cov"])
@pytest.mark.parametrize("kind", ["innovation", "information", "free", "full", "network"])
def test_a_step_equals_the_tensordict_policy(kind, policy_input):
    belief, head = make(kind, policy_input)
    step = PolicyStep(belief, head)
    forms = {"information": "information", "network": "loop"}
    assert step.form == forms.get(kind, "innovation")
    ours, our_age = run_step(step, belief.filter.obs_dim)
    expected, age = run_module(belief, head)
    torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-10)
    assert torch.equal(our_age, age)


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
        _, found, _ = step(reading, seen, action, first, mean, torch.ones(rows, 1).long())
        expected = belief.step(mean, None, action, reading, seen, first.squeeze(-1)).mean
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("kind", ["innovation", "information", "network"])
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_batch_shape_is_taken_and_the_module_may_be_cast(kind, batch):
    belief, head = make(kind)
    step = PolicyStep(belief, head)
    g = torch.Generator().manual_seed(3)
    obs, state = belief.filter.obs_dim, belief.filter.state_dim
    reading = torch.randn(*batch, obs, generator=g).double()
    seen = torch.rand(*batch, obs, generator=g) < 0.7
    action, mean = (
        torch.zeros(*batch, ACTION).double(),
        torch.randn(*batch, state, generator=g).double(),
    )
    first, age = torch.zeros(*batch, 1, dtype=torch.bool), torch.ones(*batch, 1).long()
    chosen, filtered, _ = step(reading, seen, action, first, mean, age)
    assert chosen.shape == (*batch, ACTION)
    flat = [x.reshape(-1, x.shape[-1]) for x in (reading, seen, action, first, mean, age)]
    torch.testing.assert_close(filtered.reshape(-1, state), step(*flat)[1])
    step.float()
    assert step.initial_state(2)[0].dtype == torch.float32
    cast = step(reading.float(), seen, action.float(), first, mean.float(), age)[1]
    torch.testing.assert_close(cast.double(), filtered, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", ["innovation", "information"])
def test_what_stands_under_a_false_mask_is_not_read(kind):
    belief, head = make(kind)
    step = PolicyStep(belief, head)
    observation, observed, is_init = (x[0] for x in inputs(belief.filter.obs_dim))
    rest = (torch.zeros(BATCH, ACTION, dtype=torch.float64), is_init, *step.initial_state(BATCH))
    clean = step(observation, observed, *rest)
    spoilt = step(torch.where(observed, observation, torch.nan), observed, *rest)
    for a, b in zip(clean, spoilt, strict=True):
        assert torch.equal(a, b)


def test_later_training_does_not_reach_the_copy():
    belief, head = make("innovation")
    step = PolicyStep(belief, head)
    before, _ = run_step(step, 4)
    perturbed(belief)
    perturbed(head)
    after, _ = run_step(step, 4)
    assert torch.equal(before, after)
    assert not any(p.requires_grad for p in step.parameters())


def test_a_head_may_return_location_and_scale_and_limits_clip():
    belief, head = make("innovation")

    class LocScale(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.location = head

        def forward(self, features):
            return self.location(features), torch.ones(2)

    high = torch.full((ACTION,), 0.05, dtype=torch.float64)
    plain = PolicyStep(belief, head)
    limited = PolicyStep(belief, LocScale(), action_low=-high, action_high=high)
    observation, observed, is_init = (x[0] for x in inputs(4))
    rest = (torch.zeros(BATCH, ACTION, dtype=torch.float64), is_init, *plain.initial_state(BATCH))
    action = plain(observation, observed, *rest)[0]
    assert action.abs().max() > 0.05
    clipped = limited(observation, observed, *rest)[0]
    assert torch.equal(clipped, action.clamp(-0.05, 0.05))


@pytest.mark.parametrize("kind", ["innovation", "information", "network"])
def test_export_takes_it_with_any_batch(kind):
    belief, head = make(kind)
    step = PolicyStep(belief, head)
    observation, observed, is_init = (x[0] for x in inputs(belief.filter.obs_dim))
    action = torch.zeros(BATCH, ACTION, dtype=torch.float64)
    args = (observation, observed, action, is_init, *step.initial_state(BATCH))
    batch = torch.export.Dim("batch", min=1, max=1024)
    exported = torch.export.export(step, args, dynamic_shapes=tuple({0: batch} for _ in args))
    for size in (BATCH, 7):
        rows = [torch.cat([x, x, x])[:size] for x in args]
        for a, b in zip(exported.module()(*rows), step(*rows), strict=True):
            torch.testing.assert_close(a, b)


def test_it_is_saved_and_loaded_as_a_state_dict():
    belief, head = make("innovation")
    step = PolicyStep(belief, head)
    other = PolicyStep(perturbed(belief), perturbed(head))
    other.load_state_dict(step.state_dict())
    assert torch.equal(run_step(other, 4)[0], run_step(step, 4)[0])


def test_a_belief_of_another_kind_is_refused():
    with pytest.raises(TypeError, match="`belief` must be a BeliefFilterModule"):
        PolicyStep(nn.Linear(2, 2), nn.Linear(2, 2))


def test_one_limit_alone_is_refused():
    belief, head = make("innovation")
    with pytest.raises(ValueError, match="given together"):
        PolicyStep(belief, head, action_low=torch.zeros(2))
