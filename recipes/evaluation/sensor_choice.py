"""Which sensors a trained belief would keep, by the model it has learned.

P, the covariance before the readings, is the learned Q: the paper's filter takes the transition at
the mean only (eq. 8). A sensor is thus valued by what it adds within one step: quantities that
change fast come first. H P H' and R are in the units of the normalised observation.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from training.errors import UserError

from evaluation.trained import TrainedAgent
from torchrl_drbpn import BeliefFilterModule, select_sensors


@dataclass(frozen=True)
class SensorModel:
    """What a trained belief has learned about its sensors: H, P = Q and R, float64.

    ``added_std``: deviations of the noise that the sensors did have in training, spikes included,
    in the units of R's; R should hold it, and what the model can't explain.
    """

    names: list[str]
    seed: int
    emission_matrix: Tensor
    predicted_cov: Tensor
    emission_cov: Tensor
    added_std: Tensor

    @property
    def observation_cov(self) -> Tensor:
        """Return H P H' + R, the covariance of what a step's sensors read, shape ``(obs, obs)``."""
        H = self.emission_matrix
        return H @ self.predicted_cov @ H.mT + self.emission_cov

    def ranking(self, criterion: Literal["D", "A"]) -> Tensor:
        """Return all sensors, best first, by information ("D") or by the tr H P+ H' left ("A")."""
        H, P, R = self.emission_matrix, self.predicted_cov, self.emission_cov
        target = H if criterion == "A" else None
        return select_sensors(H, P, R, len(self.names), criterion=criterion, target=target).indices

    def along(self, orders: Tensor) -> tuple[Tensor, Tensor]:
        """Return the information of the first k sensors of an order, and what they leave.

        With L L' the covariance of the readings in that order, and N N' that of their noise, the
        readings up to k hold sum_{i <= k} log(L_ii / N_ii) nats on the state; the share of tr H P
        H' that is left comes with it, both of the shape of ``orders``, ``(*batch, count)``.
        """
        pairs = orders.unsqueeze(-1), orders.unsqueeze(-2)
        readings = torch.linalg.cholesky(self.observation_cov[pairs])
        noise = torch.linalg.cholesky(self.emission_cov[pairs])
        ratio = readings.diagonal(dim1=-2, dim2=-1) / noise.diagonal(dim1=-2, dim2=-1)
        # Columns of Cov(H s, readings) L^-T: what each reading explains beside those before it.
        signal = self.observation_cov - self.emission_cov
        explained = torch.linalg.solve_triangular(readings, signal[orders], upper=False)
        taken = explained.square().sum(-1).cumsum(-1)
        return ratio.log().cumsum(-1), 1.0 - taken / signal.trace()


def learned_sensors(trained: TrainedAgent) -> SensorModel:
    """Read H, P and R from a trained belief filter; refuse a belief that has none."""
    name, module = trained.settings.belief.get("name"), trained.agent.belief
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
    noise = trained.settings.noise
    variance = (noise.sigma * noise.scale) ** 2
    if "spike_probability" in noise:
        variance += noise.spike_probability * noise.spike_std**2
    return SensorModel(
        trained.sensors,
        trained.settings.seed,
        model.emission_matrix.double().detach(),
        model.constant_cov().double().detach(),
        model.full_emission_cov().double().detach(),
        math.sqrt(variance) / trained.agent.norm.std.double(),
    )


def kept_sensors(trained: TrainedAgent, count: int) -> list[int]:
    """Return the sensors with most information on the state, by the learned model, best first."""
    return learned_sensors(trained).ranking("D")[:count].tolist()
