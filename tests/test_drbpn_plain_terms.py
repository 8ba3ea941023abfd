"""PPO's terms without TensorDict in between: `DRBPNLoss` takes them where it can.

Specified here:

- for heads and settings that it knows, every output of ClipPPOLoss and every gradient, to rounding,
  with ratios on both sides of the clipping and advantages of both signs;
- for anything else the held loss itself is called.
"""

from __future__ import annotations

import pytest
import torch
from test_drbpn_loss import gradients, make_belief_agent, make_data, make_ppo
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss
from torchrl_drbpn.objectives._clipped import plain_terms

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
    expected, received = ppo(data), plain_terms(ppo, data)
    assert received is not None
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
    assert plain_terms(ppo, data) is None
    expected = ppo(data)
    out = DRBPNLoss(agent.belief, ppo, BeliefModelLoss(), functional=False)(data)
    assert set(expected.keys()) <= set(out.keys())


def test_a_mask_of_padded_steps_calls_the_held_loss():
    agent, data = moved_agent_and_beliefs()
    ppo = make_ppo(agent, **PLAIN)
    data["collector", "mask"] = torch.ones(data.shape, dtype=torch.bool)
    assert plain_terms(ppo, data) is None
