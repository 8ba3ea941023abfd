"""A transformer memory over the last steps of the episode."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from assembly.beliefs import Belief
from assembly.beliefs.foresight import Foresight, foreseeing
from torchrl_drbpn import BeliefModelLoss

_WINDOW: NestedKey = ("recurrent", "window")
_LENGTH: NestedKey = ("recurrent", "length")
_HIDDEN: NestedKey = ("recurrent", "hidden")
_STATE = (_WINDOW, _LENGTH, _HIDDEN)


class TransformerBelief(TensorDictModuleBase):
    """Attend over the last k steps: what arrived, which entries did, the action before.

    The recurrent state is the window itself, so that a step seen alone and the same step seen in
    a sequence attend over the same k steps, however the rollout was cut. The features are the
    output at the newest step; the auxiliary task is that of the recurrent networks.

    Args:
        obs_dim: components of an observation.
        action_dim: components of an action.
        window: k, steps attended over, this one included.
        width: of tokens and features.
        heads: attention heads; divides the width.
        layers: encoder layers.
        init_std: of the foreseen observation at the start, normalised observation units.
        min_std: its floor.

    Raises:
        ValueError: for sizes that do not fit.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        *,
        window: int,
        width: int,
        heads: int,
        layers: int,
        init_std: float,
        min_std: float,
    ) -> None:
        super().__init__()
        if window < 1 or layers < 1 or heads < 1 or width % heads:
            raise ValueError(
                "`window`, `layers` and `heads` must be at least 1 and heads divide width, got "
                f"window={window}, layers={layers}, heads={heads}, width={width}."
            )
        self.window, self.width = window, width
        self.token_dim = 2 * obs_dim + action_dim
        self.embed = nn.Linear(self.token_dim, width)
        self.position = nn.Parameter(0.02 * torch.randn(window, width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 2 * width, dropout=0.0, batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(
            layer, layers, norm=nn.LayerNorm(width), enable_nested_tensor=False
        )
        self.foresight = Foresight(width, obs_dim, action_dim, init_std=init_std, min_std=min_std)
        self.in_keys = ["observation", "observed", "previous_action", "is_init", *_STATE]
        self.out_keys = [
            "features",
            ("belief", "log_likelihood"),
            *(("next", *key) for key in _STATE),
        ]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that puts the window into the environment."""
        return TensorDictPrimer(
            {
                _WINDOW: Unbounded((self.window, self.token_dim)),
                _LENGTH: Unbounded((1,), dtype=torch.int64),
                _HIDDEN: Unbounded((self.width,)),
            },
            expand_specs=True,
        )

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write features, log-likelihood and the next window.

        Args:
            tensordict: one step of any batch shape, or sequences under recurrent mode.

        Returns:
            The same tensordict.
        """
        observation = tensordict.get("observation")
        seen = tensordict.get("observed").to(observation.dtype)
        token = torch.cat([observation, seen, tensordict.get("previous_action")], -1)
        is_init = tensordict.get("is_init")
        batch = token.shape[:-1]
        rows, time = batch.numel(), 1
        if recurrent_mode():
            rows, time = batch[:-1].numel(), batch[-1]
        token = token.reshape(rows, time, self.token_dim)
        is_init = is_init.reshape(rows, time)

        window, length, hidden = self._stored(tensordict, token)
        tokens = torch.cat([window, token], 1)
        visible = self._visible(is_init, length)
        features = self._attend(tokens, visible)
        before = torch.cat([hidden.unsqueeze(1), features[:, :-1]], 1)
        before = torch.where(is_init.unsqueeze(-1), 0.0, before)

        features = features.reshape(*batch, self.width)
        tensordict.set("features", features)
        likelihood = self.foresight(before.reshape(*batch, self.width), tensordict)
        tensordict.set(("belief", "log_likelihood"), likelihood)
        windows = self._windows(tokens).reshape(*batch, self.window, self.token_dim)
        tensordict.set(("next", *_WINDOW), windows)
        tensordict.set(("next", *_LENGTH), visible.sum(-1).reshape(*batch, 1))
        tensordict.set(("next", *_HIDDEN), features)
        return tensordict

    def _stored(self, tensordict: TensorDictBase, token: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return window, its valid length and hidden state before the first step of each row."""
        rows, time = token.shape[:2]
        zeros = (
            token.new_zeros(rows, self.window, self.token_dim),
            torch.zeros(rows, 1, dtype=torch.int64, device=token.device),
            token.new_zeros(rows, self.width),
        )
        first = []
        for key, zero in zip(_STATE, zeros, strict=True):
            value = tensordict.get(key, None)
            first.append(
                zero if value is None else value.reshape(rows, time, *zero.shape[1:])[:, 0]
            )
        return first[0], first[1], first[2]

    def _windows(self, sequence: Tensor) -> Tensor:
        """Cut (rows, k + time, ...) into the k entries up to each step: (rows, time, k, ...)."""
        cut = sequence.unfold(1, self.window, 1)[:, 1:]
        return cut.movedim(-1, 2)

    def _visible(self, is_init: Tensor, length: Tensor) -> Tensor:
        """Tell which of the k steps belong to the episode of the newest, (rows, time, k)."""
        index = torch.arange(self.window, device=is_init.device)
        valid = torch.cat([index >= self.window - length, torch.ones_like(is_init)], 1)
        episode = is_init.long().cumsum(1)
        episode = torch.cat([torch.zeros_like(length).expand(-1, self.window), episode], 1)
        episodes = self._windows(episode)
        return self._windows(valid) & (episodes == episodes[..., -1:])

    def _attend(self, tokens: Tensor, visible: Tensor) -> Tensor:
        """Return the encoder's output at the newest step of every window, (rows, time, width)."""
        embedded = self._windows(self.embed(tokens)) + self.position
        rows, time = embedded.shape[:2]
        out = self.encoder(embedded.flatten(0, 1), src_key_padding_mask=~visible.flatten(0, 1))
        return out[:, -1].reshape(rows, time, self.width)


def build(
    *,
    obs_dim: int,
    action_dim: int,
    normalize: Literal["entry", "step"],
    window: int,
    width: int,
    heads: int,
    layers: int,
    init_std: float,
    min_std: float,
) -> Belief:
    """Build a transformer memory.

    Args:
        obs_dim: components of an observation.
        action_dim: components of an action.
        normalize: what the likelihood is divided by, ``entry`` or ``step``.
        window: steps attended over.
        width: of tokens and features.
        heads: attention heads.
        layers: encoder layers.
        init_std: of the foreseen observation at the start.
        min_std: its floor.

    Returns:
        The belief.
    """
    module = TransformerBelief(
        obs_dim,
        action_dim,
        window=window,
        width=width,
        heads=heads,
        layers=layers,
        init_std=init_std,
        min_std=min_std,
    )
    return Belief(
        module,
        width,
        BeliefModelLoss(normalize=normalize),
        observing=lambda: foreseeing(module, module.foresight, _HIDDEN, lambda hidden: hidden),
    )
