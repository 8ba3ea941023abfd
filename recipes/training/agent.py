"""The agent: normalisation, belief module, policy head and value head.

``evaluation.trained.load_trained_agent`` reads one back from the folder of its run.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence

import torch
from beliefs import Belief
from omegaconf import DictConfig
from safetensors import SafetensorError
from safetensors.torch import load_file
from tensordict import TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import nn
from torchrl.envs import TransformedEnv
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.modules.utils import get_primers_from_module

from torchrl_drbpn.modules import MaskedObservationNorm
from training.checkpoint import fitting
from training.config import build
from training.envs import COMPLETE
from training.errors import UserError

_SCALED_COMPLETE = f"normalized_{COMPLETE}"


class Agent(nn.Module):
    """Hold what decides and what values.

    A critic may see more than the policy, as it is left behind after training (asymmetric
    actor-critic, [Pinto et al. 2018]). It reads the complete observation beside the features, not
    in their place: the value of a policy that acts on a belief depends on that belief, and a critic
    without it is biased [Baisero and Amato 2022].

    ``policy`` is normalisation, belief module and policy head.
    """

    def __init__(
        self,
        norm: MaskedObservationNorm,
        belief: Belief,
        actor: ProbabilisticActor,
        critic: ValueOperator,
    ) -> None:
        super().__init__()
        self.norm, self.belief, self.actor, self.critic = norm, belief.module, actor, critic
        self.summary: Callable[[], Mapping[str, float]] = belief.summary
        self.observing: Callable[[], TensorDictModuleBase] | None = belief.observing
        self._after_rollout = belief.after_rollout
        self.pretrained = belief.pretrained
        # Not registered a second time: its parts are above.
        self.__dict__["policy"] = TensorDictSequential(norm, belief.module, actor)

    policy: TensorDictSequential

    @property
    def recurrent(self) -> bool:
        """Return whether the belief module carries a state from step to step."""
        return get_primers_from_module(self.belief, warn=False) is not None

    def after_rollout(self, data: TensorDictBase) -> None:
        """Let what learns otherwise than by gradients learn from a rollout, after its epochs."""
        self.norm.update(data)
        self._after_rollout(data)

    def value(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Return V of the beliefs that are stored in a rollout, shape ``(*, 1)``."""
        return self.critic.module(*(tensordict.get(key) for key in self.critic.in_keys))

    @torch.no_grad()
    def one_step_value(
        self, tensordict: TensorDictBase, where: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return V of the beliefs that one step of the belief module makes of what is stored.

        A stored step holds what arrived, the action before it and the belief before it, so one
        batched step gives every belief at once: of all steps, shape ``(*, 1)``, or of those of the
        mask ``where``, shape ``(count, 1)``.
        """
        keys = (*self.belief.in_keys, *self.critic.in_keys)
        read = tensordict.select(*keys, strict=False)
        single = read.reshape(-1) if where is None else read[where]
        value = self.value(self.belief(single))
        return value if where is not None else value.reshape(*tensordict.shape, 1)


def device_named(name: str) -> torch.device:
    """Return the device that a setting names, if it is here."""
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise UserError(f"`device` must be cpu, cuda or cuda and a number, cuda:1, got {name!r}.")
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise UserError(
            f"`device={name}` is not here: torch finds {count} CUDA devices. Take device=cpu, or a "
            "build of torch for your GPU (pytorch.org)."
        )
    return device


def make_agent(config: DictConfig, env: TransformedEnv) -> Agent:
    """Build an agent, with weights from torch's global generator."""
    obs_dim = env.observation_spec["observation"].shape[-1]
    sizes = {"obs_dim": obs_dim, "action_dim": env.action_spec.shape[-1]}
    keys, node = (COMPLETE, _SCALED_COMPLETE), config.normalisation.observation
    norm = build("normalisation.observation", node, obs_dim=obs_dim, complete_keys=keys)
    belief: Belief = build("belief", config.belief, **sizes)
    heads = build("heads", config.heads, feature_dim=belief.feature_dim, **sizes)
    return Agent(norm, belief, *heads)


def start_from_pretrained(agent: Agent) -> None:
    """Give a new agent the belief and the statistics of ``belief.pretrained``, where it is named.

    A file of recipes/fit.py, or the weights of a saved agent, whose heads are left out.
    """
    if agent.pretrained is None:
        return
    try:
        weights = load_file(agent.pretrained)
    except (SafetensorError, OSError) as error:
        raise UserError(
            f"`belief.pretrained` must be a file of recipes/fit.py, {agent.pretrained} can't be "
            "read as one."
        ) from error
    parts = ("norm.", "belief.")
    weights = {name: value for name, value in weights.items() if name.startswith(parts)}
    own = {name for name in agent.state_dict() if name.startswith(parts)}
    with fitting(agent.pretrained):
        if different := sorted(own ^ weights.keys()):
            raise KeyError(f"{different[0]} is in one of the two alone")
        agent.load_state_dict(weights, strict=False)


def add_primers(env: TransformedEnv, agent: Agent) -> None:
    """Append the entries of the belief module's recurrent state to an environment."""
    primers = get_primers_from_module(agent.belief, warn=False)
    if primers is not None:
        env.append_transform(primers)


def make_heads(
    *,
    feature_dim: int,
    obs_dim: int,
    action_dim: int,
    critic_input: str,
    hidden: Sequence[int],
    hidden_gain: float,
    policy_gain: float,
    value_gain: float,
    log_std: float,
) -> tuple[ProbabilisticActor, ValueOperator]:
    """Build policy and value networks side by side, see conf/heads/mlp.yaml."""
    if critic_input not in ("features", "complete"):
        raise ValueError(f"`critic_input` must be features or complete, got {critic_input!r}.")
    scale = AddStateIndependentNormalScale(action_dim)
    nn.init.constant_(scale.state_independent_scale, log_std)
    location = _mlp([feature_dim, *hidden, action_dim], hidden_gain, policy_gain)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(location, scale), in_keys=["features"], out_keys=["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    complete = critic_input == "complete"
    width = feature_dim + (obs_dim if complete else 0)
    value = _mlp([width, *hidden, 1], hidden_gain, value_gain)
    critic = ValueOperator(
        _SideBySide(*value) if complete else value,
        in_keys=["features", _SCALED_COMPLETE] if complete else ["features"],
    )
    return actor, critic


class _SideBySide(nn.Sequential):
    """A network of several inputs, joined in their last dimension."""

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        joined = torch.cat(inputs, -1)
        return super().forward(joined)  # type: ignore[no-untyped-call]


def _mlp(sizes: list[int], hidden_gain: float, last_gain: float) -> nn.Sequential:
    """Build a tanh network with orthogonal weights and zero biases."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        last = i == len(sizes) - 2
        linear = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(linear.weight, last_gain if last else hidden_gain)
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.Tanh()]
    return nn.Sequential(*layers)
