"""The auxiliary task of the networks without a model: foresee the next observation."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_drbpn.functional import inverse_softplus, positive_std, zero_missing


class Foresight(nn.Module):
    r"""Say how likely what arrived was, given the hidden state before it.

    .. math:: \log N(x_t^{obs}; g(h_{t-1}, a_{t-1}), \mathrm{diag}(\sigma^2))

    Args:
        hidden_size: width of the hidden state.
        obs_dim: components of an observation.
        action_dim: components of an action.
        init_std: sigma at the start, normalised observation units.
        min_std: its floor.
    """

    def __init__(
        self, hidden_size: int, obs_dim: int, action_dim: int, *, init_std: float, min_std: float
    ) -> None:
        super().__init__()
        self.min_std = min_std
        self.mean = nn.Sequential(
            nn.Linear(hidden_size + action_dim, hidden_size),
            nn.Tanh(),
            nn.Linear(hidden_size, obs_dim),
        )
        self.raw_std = nn.Parameter(inverse_softplus(torch.full((obs_dim,), init_std - min_std)))

    def forward(self, hidden: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the log-likelihood of what arrived, as foreseen from the step before.

        Args:
            hidden: hidden state before the step, shape ``(*, hidden)``.
            tensordict: with ``observation``, ``observed`` and ``previous_action``.

        Returns:
            Shape ``(*,)``, nats; 0 where nothing arrived.
        """
        observed = tensordict.get("observed")
        seen = zero_missing(tensordict.get("observation"), observed)
        mean = self.mean(torch.cat([hidden, tensordict.get("previous_action")], -1))
        std = positive_std(self.raw_std, self.min_std)
        density = torch.distributions.Normal(mean, std, validate_args=False).log_prob(seen)
        return zero_missing(density, observed).sum(-1)
