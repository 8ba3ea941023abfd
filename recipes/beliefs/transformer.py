"""A transformer with a memory of its layers' inputs over the last steps of the episode."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from beliefs import OBSERVATION, Belief
from beliefs.prediction_head import PredictionHead, with_prediction

_MEMORY: NestedKey = ("recurrent", "memory")
_LENGTH: NestedKey = ("recurrent", "length")
_HIDDEN: NestedKey = ("recurrent", "hidden")
_STATE = (_MEMORY, _LENGTH, _HIDDEN)


class MemoryAttention(nn.Module):
    r"""Multi-head attention of some steps over themselves and the k - 1 steps before each.

    For each head of dimension d, a query x and the entries m_j at distance j:

    .. math::
        p = \mathrm{softmax}_j\big((W_q x + c)^\top W_k (m_j + r_j) / \sqrt d\big), \qquad
        y = \sum_{heads} W_o W_v \sum_j p_j m_j + e

    with a learned r_j in the place of Transformer-XL's projected sinusoids. With r = 0 it is what
    ``nn.MultiheadAttention`` computes, in another order: W_k is applied to the query and W_v to the
    average, so that no entry is projected again.
    """

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__()
        self.split = (heads, width // heads, width)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, width)
        # Oldest first. As large as the normalised entries that they are added to: distances can be
        # told apart from the start. One bias per distance instead learns this many times slower.
        self.position = nn.Parameter(torch.randn(window, width))
        for layer in (self.query, self.key, self.value):
            # Where nn.MultiheadAttention starts: the three as one matrix.
            nn.init.xavier_uniform_(layer.weight, gain=0.5**0.5)
        nn.init.zeros_(self.query.bias)
        nn.init.zeros_(self.out.bias)

    def forward(self, entries: Tensor, visible: Tensor) -> Tensor:
        """Attend from the last steps, shape ``(rows, time, width)``.

        ``entries``: k - 1 remembered ones, then the steps, ``(rows, k - 1 + time, width)``;
        ``visible``: whether an entry is of the episode of a step, ``(rows, time, k - 1 + time)``.
        """
        time, (heads, head_dim, _) = visible.shape[1], self.split
        query = self.query(entries[:, -time:]).unflatten(-1, (heads, head_dim))
        query = torch.einsum("rthd,hdw->rhtw", query, self.key.weight.view(self.split))
        scores = query @ entries.unsqueeze(1).mT + shifted(query @ self.position.T)
        scores = scores.where(visible.unsqueeze(1), -torch.inf) * head_dim**-0.5
        mean = scores.softmax(-1) @ entries.unsqueeze(1)
        value = torch.einsum("rhtw,hdw->rthd", mean, self.value.weight.view(self.split))
        out: Tensor = self.out(value.flatten(-2))
        return out


def shifted(window: Tensor) -> Tensor:
    """Put the k values of each step t, ``(*, time, k)``, at entries t on of ``k - 1 + time``.

    Elsewhere the result is -inf.
    """
    time, size = window.shape[-2:]
    count = size - 1 + time
    # Read with rows of `count`, rows of one more begin one further right each time.
    padded = nn.functional.pad(window, (0, time), value=float("-inf"))
    return padded.flatten(-2)[..., : time * count].view(*window.shape[:-1], count)


class MemoryLayer(nn.Module):
    """A pre-norm encoder layer that attends over its own inputs at earlier steps."""

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__()
        # Without a scale of its own: those of the projections do it, and what is remembered
        # depends on the layers below alone.
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.attention = MemoryAttention(width, heads, window)
        self.feedforward = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: Tensor, memory: Tensor, visible: Tensor) -> tuple[Tensor, Tensor]:
        """Return the steps' outputs, and the memory with their normalised inputs after it.

        ``memory``: the normalised inputs of the layer at the k - 1 steps before, oldest first,
        ``(rows, k - 1, width)``; the others as in :class:`MemoryAttention`.
        """
        entries = torch.cat([memory, self.norm(x)], 1)
        x = x + self.attention(entries, visible)
        return x + self.feedforward(x), entries


class TransformerBelief(TensorDictModuleBase):
    """Attend over the last k steps: what arrived, which entries did, the action before.

    A causal transformer with a memory, as Transformer-XL [Dai et al. 2019] and, for reinforcement
    learning, GTrXL [Parisotto et al. 2020]: a step passes through the layers once, and each layer
    attends over the step and its own inputs at the k - 1 steps before it in the same episode.

    The recurrent state is the memory: normalised inputs of every layer, of which the current
    weights make keys and values. No gradient flows into it. A step seen alone and the same step
    seen in a sequence give the same features, as long as the parameters stay.
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
        if window < 1 or layers < 1 or heads < 1 or width < 1 or width % heads:
            raise ValueError(
                "`window`, `width`, `layers` and `heads` must be at least 1 and heads divide "
                f"width, got window={window}, width={width}, layers={layers}, heads={heads}."
            )
        self.window, self.width = window, width
        self.embed = nn.Linear(2 * obs_dim + action_dim, width)
        self.layers = nn.ModuleList(MemoryLayer(width, heads, window) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.prediction_head = PredictionHead(
            width, obs_dim, action_dim, init_std=init_std, min_std=min_std
        )
        self.in_keys = [OBSERVATION, "observed", "previous_action", "is_init", *_STATE]
        following = [("next", *key) for key in _STATE]
        self.out_keys = ["features", ("belief", "log_likelihood"), *following]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that puts the memory into the environment."""
        return TensorDictPrimer(
            {
                _MEMORY: Unbounded((len(self.layers), self.window - 1, self.width)),
                _LENGTH: Unbounded((1,), dtype=torch.int64),
                _HIDDEN: Unbounded((self.width,)),
            },
            expand_specs=True,
        )

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write features, log-likelihood and the next memory."""
        observation = tensordict.get(OBSERVATION)
        seen = tensordict.get("observed").to(observation.dtype)
        token = torch.cat([observation, seen, tensordict.get("previous_action")], -1)
        is_init = tensordict.get("is_init")
        batch = token.shape[:-1]
        time = batch[-1] if recurrent_mode() else 1
        rows = batch.numel() // time
        x = self.embed(token.reshape(rows, time, token.shape[-1]))
        is_init = is_init.reshape(rows, time)

        memory, length, hidden = self._stored(tensordict, x)
        step = torch.arange(time, device=x.device)
        # Where the episode of each step began, counted from the first; the memory lies before it.
        start = torch.where(is_init, step, -length).cummax(1).values
        features, memories = self._attend(x, memory, start)
        before = torch.cat([hidden.unsqueeze(1), features[:, :-1]], 1)
        before = torch.where(is_init.unsqueeze(-1), 0.0, before)

        features = features.reshape(*batch, self.width)
        tensordict.set("features", features)
        likelihood = self.prediction_head(before.reshape(*batch, self.width), tensordict)
        tensordict.set(("belief", "log_likelihood"), likelihood)
        tensordict.set(("next", *_MEMORY), memories.reshape(*batch, *memories.shape[2:]))
        length = (step - start + 1).clamp_max(self.window - 1)
        tensordict.set(("next", *_LENGTH), length.reshape(*batch, 1))
        tensordict.set(("next", *_HIDDEN), features)
        return tensordict

    def _stored(self, tensordict: TensorDictBase, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return memory, its valid length and hidden state before the first step of each row."""
        rows, time = x.shape[:2]
        zeros = (
            x.new_zeros(rows, len(self.layers), self.window - 1, self.width),
            torch.zeros(rows, 1, dtype=torch.int64, device=x.device),
            x.new_zeros(rows, self.width),
        )
        first = []
        for key, zero in zip(_STATE, zeros, strict=True):
            value = tensordict.get(key, zero.unsqueeze(1).expand(-1, time, *zero.shape[1:]))
            first.append(value.reshape(rows, time, *zero.shape[1:])[:, 0])
        return first[0], first[1], first[2]

    def _attend(self, x: Tensor, memory: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Return features and memory after each step, of episodes that began at ``start``."""
        # The entries by the step they belong to; which are outside the window the layers know.
        entry = torch.arange(1 - self.window, x.shape[1], device=x.device)
        visible = entry >= start.unsqueeze(-1)
        remembered = []
        for i, layer in enumerate(self.layers):
            x, entries = layer(x, memory[:, i], visible)
            remembered.append(entries.detach())
        # Views of the last k - 1 entries up to each step: a sequence's are read by nobody.
        windows = torch.stack(remembered, 1).unfold(2, self.window - 1, 1)[:, :, 1:]
        return self.norm(x), windows.permute(0, 2, 1, 4, 3)


def build(*, obs_dim: int, action_dim: int, **settings: Any) -> Belief:
    """Build a transformer memory; the settings are those of :class:`TransformerBelief`."""
    module = TransformerBelief(obs_dim, action_dim, **settings)

    def observing() -> TensorDictModuleBase:
        return with_prediction(module, module.prediction_head, _HIDDEN, lambda hidden: hidden)

    return Belief(module, module.width, observing=observing)
