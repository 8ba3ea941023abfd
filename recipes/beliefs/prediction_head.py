"""The auxiliary task of the networks without a model: predict the next observation."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn

from beliefs import FORECAST, FORECAST_COV, OBSERVATION
from torchrl_drbpn.functional.gaussian import inverse_softplus, positive_std, zero_missing


class PredictionHead(nn.Module):
    r"""Say how likely what arrived was, given the hidden state before it.

    .. math:: \log N(x_t^{obs}; g(h_{t-1}, a_{t-1}), \mathrm{diag}(\sigma^2))

    sigma starts at ``init_std`` and stays above ``min_std``, normalised observation units.
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
        """Return the log-likelihood of what arrived, nats, shape ``(*,)``; 0 where nothing did."""
        observed = tensordict.get("observed")
        seen = zero_missing(tensordict.get(OBSERVATION), observed)
        mean, std = self.predict(hidden, tensordict.get("previous_action"))
        normal = torch.distributions.Normal(mean, std, validate_args=False)
        density = normal.log_prob(seen)  # type: ignore[no-untyped-call]
        return zero_missing(density, observed).sum(-1)

    def predict(self, hidden: Tensor, previous_action: Tensor) -> tuple[Tensor, Tensor]:
        """Return g, shape ``(*, obs)``, and sigma, shape ``(obs,)``, of the next observation."""
        mean = self.mean(torch.cat([hidden, previous_action], -1))
        return mean, positive_std(self.raw_std, self.min_std)


def with_prediction(
    module: TensorDictModuleBase,
    prediction_head: PredictionHead,
    state_key: NestedKey,
    hidden_of: Callable[[Tensor], Tensor],
) -> TensorDictSequential:
    """Make a recurrent belief write its prediction of the observation, before it reads it.

    ``hidden_of`` picks the hidden state out of the recurrent one that is read at ``state_key``.
    """

    def predict(state: Tensor, action: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """Return the forecast, ``(*, obs)``, and its covariance; an episode starts from zeros."""
        hidden = torch.where(is_init, 0.0, hidden_of(state))
        mean, std = prediction_head.predict(hidden, action)
        return mean, torch.diag_embed(std.square().expand_as(mean))

    in_keys = [state_key, "previous_action", "is_init"]
    prediction = TensorDictModule(predict, in_keys=in_keys, out_keys=[FORECAST, FORECAST_COV])
    return TensorDictSequential(prediction, module)
