"""Which sensors a trained belief would keep, by the model it has learned.

P, the covariance before the readings, is the learned Q: the paper's filter takes the transition at
the mean only, so that Q is what every step but an episode's first predicts, whatever arrived before
(eq. 8). H, P and R are in the units of the normalised observation, so sensors compare by what they
say against their own spread in training.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from assembly.errors import UserError
from assembly.sensors import sensor_names
from assembly.trained import TrainedAgent
from torchrl_drbpn import BeliefFilterModule, select_sensors


@dataclass(frozen=True)
class SensorModel:
    """What a trained belief has learned about its sensors, float64.

    Attributes:
        names: of the sensors.
        emission_matrix: H, shape ``(obs, state)``.
        predicted_cov: P = Q, shape ``(state, state)``.
        emission_cov: R, shape ``(obs, obs)``.
    """

    names: list[str]
    emission_matrix: Tensor
    predicted_cov: Tensor
    emission_cov: Tensor

    @property
    def observation_cov(self) -> Tensor:
        """Return H P H' + R, the covariance of what a step's sensors read, shape ``(obs, obs)``."""
        H = self.emission_matrix
        return H @ self.predicted_cov @ H.mT + self.emission_cov


def learned_sensors(trained: TrainedAgent) -> SensorModel:
    """Read H, P and R from a trained belief.

    Args:
        trained: the agent; its belief must be the belief filter.

    Returns:
        The model of its sensors.

    Raises:
        UserError: if the belief has no H, P and R, or no P that holds at every step.
    """
    name = trained.settings.belief.get("name")
    module = trained.agent.belief
    if not isinstance(module, BeliefFilterModule):
        raise UserError(
            f"`belief={name}` has learned no H, P and R to choose sensors by: take a run with "
            "belief=drbpn."
        )
    with torch.no_grad():
        model = module.filter.state_space()
    if not isinstance(model.transition_cov, Tensor):
        raise UserError(
            f"`belief={name}` predicts another covariance at every state "
            "(belief.transition.cov_network=true), so no one P ranks its sensors: take a run with "
            "cov_network=false."
        )
    env = trained.settings.env
    wide = model.double()
    return SensorModel(
        sensor_names(env.id, env.version, wide.emission_matrix.shape[0]),
        wide.emission_matrix.detach(),
        model.transition_cov.double().detach(),
        wide.full_emission_cov().detach(),
    )


def kept_sensors(trained: TrainedAgent, count: int) -> list[int]:
    """Return the sensors that tell most about the state, by the learned H, P and R.

    Greedy D-optimal, see :func:`torchrl_drbpn.select_sensors`; the first sensors of a larger count
    are those of a smaller one.

    Args:
        trained: the agent; its belief must be the belief filter.
        count: how many sensors to keep.

    Returns:
        Indices of components, best first.

    Raises:
        UserError: if the belief has no H, P and R, or has not that many sensors.
    """
    model = learned_sensors(trained)
    if not 0 <= count <= len(model.names):
        raise UserError(
            f"`count` must be from 0 to the {len(model.names)} sensors of "
            f"{trained.settings.env.env_id}, got {count}."
        )
    chosen = select_sensors(
        model.emission_matrix, model.predicted_cov, model.emission_cov, count, criterion="D"
    )
    return chosen.indices.tolist()
