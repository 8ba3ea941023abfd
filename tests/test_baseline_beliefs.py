"""What the recipe's other belief modules do that not all of them do.

The auxiliary likelihood counts what arrived and nothing else; gru_action reads the action and gru
does not; filling keeps the last value. The transformer has test_transformer_belief.py; what every
belief owes the recipe stands in test_recipe_beliefs.py.
"""

from __future__ import annotations

import recipe_tools
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

OBS, ACTION, TIME = 5, 2, 7


def make_belief(name: str):
    from training.config import build

    config = recipe_tools.make_config(*f"belief={name}".split())
    torch.manual_seed(0)
    return build("belief", config.belief, obs_dim=OBS, action_dim=ACTION)


def make_frames(batch: int, seed: int = 0) -> TensorDict:
    g = torch.Generator().manual_seed(seed)
    observed = torch.rand(batch, TIME, OBS, generator=g) < 0.6
    is_init = torch.zeros(batch, TIME, 1, dtype=torch.bool)
    is_init[:, 0] = True
    is_init[0, 3] = True
    return TensorDict(
        {
            "normalized_observation": torch.where(
                observed, torch.randn(batch, TIME, OBS, generator=g), 0.0
            ),
            "observed": observed,
            "previous_action": torch.randn(batch, TIME, ACTION, generator=g),
            "is_init": is_init,
        },
        [batch, TIME],
    )


def test_the_likelihood_is_that_of_the_entries_that_arrived():
    module = make_belief("gru").module
    frames = make_frames(3)
    frames["observed"][:] = False
    frames["normalized_observation"][:] = float("nan")
    frames["observed"][1, 2, 4] = True
    frames["normalized_observation"][1, 2, 4] = 0.7
    value = module.prediction_head(torch.zeros(3, TIME, 64), frames)
    expected = torch.zeros(3, TIME)
    ahead = module.prediction_head.mean(
        torch.cat([torch.zeros(64), frames["previous_action"][1, 2]])
    )
    density = torch.distributions.Normal(ahead[4], 1.0).log_prob(torch.tensor(0.7))
    expected[1, 2] = density.detach()
    assert torch.allclose(value, expected, atol=1e-5)


def test_only_gru_action_reads_the_action():
    changed = make_frames(3)
    changed["previous_action"] += 1.0
    for name, reads in (("gru", False), ("gru_action", True)):
        module = make_belief(name).module
        with set_recurrent_mode(True):
            before = module(make_frames(3))["features"]
            after = module(changed.clone())["features"]
        assert torch.equal(before, after) is not reads


def test_filling_holds_the_last_normalised_value_and_the_mean_before_the_first():
    with torch.random.fork_rng():
        words = ("experiment=smoke", "belief=fill", "missingness=mcar")
        training, _ = recipe_tools.assembled(*words)
        training.agent.norm.update(training.collector.rollout())
        training.start_episodes()
        data = training.collector.rollout()
    seen, value, start = data["observed"], data["normalized_observation"], data["is_init"]
    held = torch.zeros_like(value[:, 0])  # 0 is the running mean, which raw 0 may be far from
    never = 0
    for t in range(data.shape[1]):
        held = torch.where(start[:, t], 0.0, held)
        held = torch.where(seen[:, t], value[:, t], held)
        assert torch.equal(data["features"][:, t], held)
        never += int((held == 0).sum())
    assert never > 0
    assert (data["features"][~seen] != 0).float().mean() > 0.5
