"""Recurrent networks as belief modules: TorchRL's GRUModule or LSTMModule (DR-PPO, ADR-PPO)."""

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.modules import GRUModule, LSTMModule

from beliefs import OBSERVATION, Belief
from beliefs.prediction_head import PredictionHead, with_prediction

_INPUT, _STATE, _STATE_C = "recurrent_input", "recurrent_state", "recurrent_state_c"


class RecurrentBelief(TensorDictModuleBase):
    r"""Run a recurrent network over (what arrived, which entries did[, previous action]).

    .. math:: h_t = \mathrm{RNN}(h_{t-1}, [x_t, m_t, a_{t-1}])

    The features are h. Its auxiliary task, the paper's for DR-PPO and ADR-PPO, is to predict the
    next observation: see :class:`~beliefs.prediction_head.PredictionHead`.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        *,
        cell: Literal["gru", "lstm"],
        hidden_size: int,
        with_action: bool,
        init_std: float,
        min_std: float,
    ) -> None:
        super().__init__()
        if cell not in ("gru", "lstm"):
            raise ValueError(f"`cell` must be 'gru' or 'lstm', got {cell!r}.")
        if hidden_size < 1:
            raise ValueError(f"`hidden_size` must be at least 1, got {hidden_size}.")
        self.with_action = with_action
        width = 2 * obs_dim + (action_dim if with_action else 0)
        states = [_STATE] if cell == "gru" else [_STATE, _STATE_C]
        self.memory = (GRUModule if cell == "gru" else LSTMModule)(
            input_size=width,
            hidden_size=hidden_size,
            in_keys=[_INPUT, *states],
            out_keys=["features", *(("next", key) for key in states)],
        )
        self.prediction_head = PredictionHead(
            hidden_size, obs_dim, action_dim, init_std=init_std, min_std=min_std
        )
        self.in_keys = [OBSERVATION, "observed", "previous_action", "is_init", *states]
        self.out_keys = ["features", ("belief", "log_likelihood"), *self.memory.out_keys[1:]]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write features, log-likelihood and the next hidden state."""
        observation = tensordict.get(OBSERVATION)
        parts = [observation, tensordict.get("observed").to(observation.dtype)]
        if self.with_action:
            parts.append(tensordict.get("previous_action"))
        stored = tensordict.get(_STATE, None)
        # A copy: the network's input is nothing to keep in the data.
        data = tensordict.copy().set(_INPUT, torch.cat(parts, -1))
        self.memory(data)
        features = data.get("features")
        tensordict.set("features", features)
        for key in self.memory.out_keys[1:]:
            tensordict.set(key, data.get(key))
        before = self._before(features, stored, tensordict.get("is_init"))
        tensordict.set(("belief", "log_likelihood"), self.prediction_head(before, tensordict))
        return tensordict

    def _before(self, features: Tensor, stored: Tensor | None, is_init: Tensor) -> Tensor:
        """Return the hidden state before each step; zero where an episode starts."""
        given = torch.zeros_like(features) if stored is None else last_layer(stored)
        if self.memory.recurrent_mode:
            given = torch.cat([given[..., :1, :], features[..., :-1, :]], -2)
        return torch.where(is_init, 0.0, given)


def last_layer(stored: Tensor) -> Tensor:
    """Return the hidden state ``(*, hidden)`` of the features, of ``(*, layers, hidden)``."""
    return stored[..., -1, :]


def build(*, obs_dim: int, action_dim: int, **settings: Any) -> Belief:
    """Build a recurrent belief; the settings are those of :class:`RecurrentBelief`."""
    module = RecurrentBelief(obs_dim, action_dim, **settings)
    return Belief(
        module,
        settings["hidden_size"],
        observing=lambda: with_prediction(module, module.prediction_head, _STATE, last_layer),
    )
