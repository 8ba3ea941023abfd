"""PPO's terms without TensorDict in between: `DRBPNLoss` takes them where it can.

Specified here:

- for heads and settings that it knows, every output of ClipPPOLoss and every gradient, to rounding,
  with ratios on both sides of the clipping and advantages of both signs;
- for anything else the held loss itself is called;
- the belief filter on plain tensors, with the model's term, gives what its module and the model
  loss give, and anything that it does not know goes through these.
"""

from __future__ import annotations

import pytest
import torch
from test_drbpn_loss import cut, gradients, make_belief_agent, make_data, make_ppo
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import BeliefFilterModule, BeliefModelLoss, DRBPNLoss
from torchrl_drbpn.objectives._clipped import plain_heads, plain_terms
from torchrl_drbpn.objectives._filtered import filtered_terms

PLAIN = {"entropy_bonus": False, "log_explained_variance": False, "functional": False}


def moved_agent_and_beliefs():
    """An agent some way from the one that collected, and what its belief module writes."""
    agent, data = make_belief_agent(), make_data()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for head in (agent.actor, agent.critic):
            for parameter in head.parameters():
                parameter += 0.3 * torch.randn(
                    parameter.shape, generator=generator, dtype=parameter.dtype
                )
    with set_recurrent_mode(True):
        agent.belief(data)
    return agent, data


@pytest.mark.parametrize("normalize", [True, False], ids=["normalised", "raw advantage"])
@pytest.mark.parametrize("kind", ["l1", "l2", "smooth_l1"])
@pytest.mark.parametrize("clip", [0.05, (0.1, 0.3)], ids=["symmetric", "asymmetric"])
def test_every_term_and_gradient_is_that_of_the_held_loss(normalize, kind, clip):
    agent, data = moved_agent_and_beliefs()
    settings = {"normalize_advantage": normalize, "loss_critic_type": kind, "clip_epsilon": clip}
    ppo = make_ppo(agent, critic_coeff=0.7, **settings, **PLAIN)
    heads = plain_heads(ppo, data)
    assert heads is not None
    expected, received = ppo(data), plain_terms(ppo, heads, data, {})
    assert 0 < expected["clip_fraction"] < 1
    assert set(received) == set(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(received[key], value, rtol=1e-10, atol=1e-12, msg=key)
        assert received[key].requires_grad == value.requires_grad, key
    for key in ("loss_objective", "loss_critic"):
        pairs = zip(gradients(agent, received[key]), gradients(agent, expected[key]), strict=True)
        for a, b in pairs:
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "beyond",
    [
        {"entropy_bonus": True},
        {"log_explained_variance": True},
        {"functional": True},
        {"clip_value": 0.2},
        {"separate_losses": True},
        {"reduction": "sum"},
        {"max_importance_ratio": 2.0},
    ],
    ids=lambda setting: next(iter(setting)),
)
def test_a_setting_beyond_the_plain_terms_calls_the_held_loss(beyond):
    agent, data = moved_agent_and_beliefs()
    ppo = make_ppo(agent, **{**PLAIN, **beyond})
    assert plain_heads(ppo, data) is None
    expected = ppo(data)
    out = DRBPNLoss(agent.belief, ppo, BeliefModelLoss(), functional=False)(data)
    assert set(expected.keys()) <= set(out.keys())


def test_a_mask_of_padded_steps_calls_the_held_loss():
    agent, data = moved_agent_and_beliefs()
    ppo = make_ppo(agent, **PLAIN)
    data["collector", "mask"] = torch.ones(data.shape, dtype=torch.bool)
    assert plain_heads(ppo, data) is None


def both_ways(agent, data, model, **kwargs):
    """The loss on plain tensors, and the same loss with a hook that makes it call the modules."""
    ppo = make_ppo(agent, normalize_advantage=True, **PLAIN)
    loss = DRBPNLoss(agent.belief, ppo, model, functional=False, **kwargs)
    with set_recurrent_mode(True):
        assert filtered_terms(agent.belief, model, data) is not None
    calls = []
    plain = loss(data)
    hook = agent.belief.register_forward_hook(lambda *_: calls.append(1))
    through_modules = loss(data)
    hook.remove()
    assert len(calls) == 1
    return plain, through_modules


@pytest.mark.parametrize("length", [24, 6, 1])
@pytest.mark.parametrize("normalize", ["entry", "step", None])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_filter_on_plain_tensors_gives_what_the_modules_give(length, normalize, dtype):
    agent, data = make_belief_agent(dtype), cut(make_data(dtype), length)
    assert data["next", "done"].any()
    assert data["final"].any()
    before = data.clone()
    model = None if normalize is None else BeliefModelLoss(normalize=normalize)
    received, expected = both_ways(agent, data, model, model_coeff=0.3)
    tight = {"rtol": 1e-5, "atol": 1e-6} if dtype is torch.float32 else {"rtol": 1e-10}
    tight = {"atol": 1e-12, **tight}
    assert list(received.keys()) == list(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(received[key], value, **tight, msg=key)
        assert received[key].requires_grad == value.requires_grad, key
        if key.startswith("loss"):
            pairs = zip(gradients(agent, received[key]), gradients(agent, value), strict=True)
            for a, b in pairs:
                torch.testing.assert_close(a, b, **tight)
    assert (data == before).all(), "nothing is written into the batch"
    assert set(data.keys(True, True)) == set(before.keys(True, True))


@pytest.mark.parametrize("absent", ["final", ("next", "done"), ("next", "observed")])
def test_absent_ends_count_as_they_do_through_the_modules(absent):
    agent = make_belief_agent()
    data = make_data().exclude(absent)
    received, expected = both_ways(agent, data, BeliefModelLoss())
    torch.testing.assert_close(received["loss_model"], expected["loss_model"], rtol=1e-10, atol=0)


def test_a_belief_detached_from_ppo_is_detached_on_plain_tensors_too():
    agent, data = make_belief_agent(), make_data()
    received, expected = both_ways(agent, data, BeliefModelLoss(), detach_belief=True)
    totals = [
        sum(v for k, v in out.items() if k.startswith("loss")) for out in (received, expected)
    ]
    for a, b in zip(*(gradients(agent, total) for total in totals), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


def test_what_the_plain_filter_does_not_know_goes_through_the_modules():
    agent, data = make_belief_agent(), make_data()
    model = BeliefModelLoss()
    with set_recurrent_mode(True):
        assert filtered_terms(agent.belief, model, data) is not None
        assert filtered_terms(agent.belief, BeliefModelLoss(reduction="sum"), data) is None
        renamed = BeliefModelLoss()
        renamed.set_keys(observed="arrived")
        assert filtered_terms(agent.belief, renamed, data) is None
        assert filtered_terms(agent.belief, model, data.exclude("recurrent")) is None
        masked = data.copy().set(("collector", "mask"), torch.ones(data.shape, dtype=torch.bool))
        assert filtered_terms(agent.belief, model, masked) is None
        more = BeliefFilterModule(agent.belief.filter, policy_input="mean_cov")
        assert filtered_terms(more, model, data) is None
    with set_recurrent_mode(False):
        assert filtered_terms(agent.belief, model, data) is None
