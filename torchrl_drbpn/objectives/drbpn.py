"""DRBPN's loss: PPO on beliefs plus the model's likelihood, from one filter pass."""

from contextlib import nullcontext
from dataclasses import dataclass, fields
from typing import Any, Literal, Self

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_drbpn.objectives.belief_model import BeliefModelLoss, in_next


def _held(name: str) -> Any:
    """Pass a coefficient on to the held PPO loss, which copies a number into its buffer."""

    def read(self: Any) -> Any:
        return getattr(self.ppo_loss, name)

    def write(self: Any, value: Any) -> None:
        setattr(self.ppo_loss, name, value.item() if isinstance(value, Tensor) else value)

    return property(read, write, doc=f"``{name}`` of the held PPO loss.")


class DRBPNLoss(LossModule):
    r"""Run the belief module once, then the PPO loss and the model loss on what it wrote.

    .. math:: L = L^{objective} + \lambda_v L^{critic} + \lambda_m L^{model}

    Eq. (13) [DRBPN]: one pass, and all gradients reach the filter. ``loss_model`` comes out
    weighted by ``model_coeff``, so the sum of all ``loss_*`` is the total.

    The input is a batch of sequences, ``[*batch, time]``, cut from rollouts, with the recurrent
    state that the collector stored. Where no other step holds the next observation
    (:meth:`BeliefModelLoss.last_steps`), one more step of the belief module adds its likelihood.

    Keys and coefficients are those of the held losses, set here or there. ``actor_network`` and
    ``critic_network`` are the belief module followed by the head.

    Args:
        filter_module: a belief module, such as :class:`~torchrl_drbpn.BeliefFilterModule`.
        ppo_loss: TorchRL's ClipPPOLoss over heads, actor and critic, that read what the belief
            module writes (``features``). The belief module is functionalised if it is.
        model_loss: the model loss, None for belief modules without a likelihood.

    Keyword Args:
        model_coeff: lambda_m, at least 0; ``loss.model_coeff = 0.3`` changes it in place.
        detach_belief: keep PPO's gradient out of the filter.

    Raises:
        ValueError: for a negative coefficient, and for a model loss over a belief module that
            writes no likelihood.
        KeyError: if advantages are not in the tensordict.

    Example:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule as Mod, ProbabilisticTensorDictSequential
        >>> from tensordict.nn import NormalParamExtractor, ProbabilisticTensorDictModule
        >>> from torchrl.modules import ValueOperator, IndependentNormal
        >>> from torchrl_drbpn import BeliefFilter, BeliefFilterModule, BeliefModelLoss
        >>> belief = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
        >>> head = torch.nn.Sequential(torch.nn.Linear(5, 4), NormalParamExtractor())
        >>> actor = ProbabilisticTensorDictSequential(
        ...     Mod(head, in_keys=["features"], out_keys=["loc", "scale"]),
        ...     ProbabilisticTensorDictModule(["loc", "scale"], ["action"],
        ...         distribution_class=IndependentNormal, return_log_prob=True))
        >>> critic = ValueOperator(torch.nn.Linear(5, 1), in_keys=["features"])
        >>> loss = DRBPNLoss(belief, ClipPPOLoss(actor, critic), BeliefModelLoss())
        >>> sorted(key for key in loss.out_keys if key.startswith("loss"))
        ['loss_critic', 'loss_entropy', 'loss_model', 'loss_objective']
    """

    @dataclass
    class _AcceptedKeys(ClipPPOLoss.default_keys, BeliefModelLoss._AcceptedKeys):
        """Name the entries read: those of the held losses, and what starts an episode."""

        is_init: NestedKey = "is_init"

    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.GAE
    SUPPORTED_VALUE_ESTIMATORS = ClipPPOLoss.SUPPORTED_VALUE_ESTIMATORS
    filter_network: TensorDictModuleBase
    filter_network_params: TensorDictParams | None
    target_filter_network_params: TensorDictParams
    _schedulable_buffers = frozenset({"model_coeff"})

    entropy_coeff = _held("entropy_coeff")
    critic_coeff = _held("critic_coeff")
    clip_epsilon = _held("clip_epsilon")
    clip_epsilon_low = _held("clip_epsilon_low")
    clip_epsilon_high = _held("clip_epsilon_high")
    clip_value = _held("clip_value")
    max_importance_ratio = _held("max_importance_ratio")

    def __init__(
        self,
        filter_module: TensorDictModuleBase,
        ppo_loss: ClipPPOLoss,
        model_loss: BeliefModelLoss | None,
        *,
        model_coeff: float = 1.0,
        detach_belief: bool = False,
    ) -> None:
        super().__init__()
        self._own_keys: DRBPNLoss._AcceptedKeys = super().tensor_keys
        if model_coeff < 0:
            raise ValueError(f"`model_coeff` must be at least 0, got {model_coeff}.")
        if model_loss is not None:
            key = unravel_key(model_loss.tensor_keys.log_likelihood)
            if key not in [unravel_key(out) for out in filter_module.out_keys]:
                raise ValueError(
                    f"`model_loss` reads {key!r}, which is not among the out_keys "
                    f"{filter_module.out_keys} of `filter_module`. Add it there, rename it by "
                    "model_loss.set_keys(log_likelihood=...), or pass model_loss=None."
                )
        if ppo_loss.functional:
            self.convert_to_functional(filter_module, "filter_network")
        else:
            self.filter_network = filter_module
            self.filter_network_params = None
        self.ppo_loss = ppo_loss
        self.model_loss = model_loss
        self.detach_belief = detach_belief
        self.register_coeff_buffer("model_coeff", model_coeff)

    @property
    def tensor_keys(self) -> _AcceptedKeys:
        """The entries read, by the names that they have in the held losses."""
        keys = self._own_keys
        for part in (self.model_loss, self.ppo_loss):
            for name, key in vars(part.tensor_keys).items() if part is not None else ():
                setattr(keys, name, key)
        return keys

    def set_keys(self, **kwargs: Any) -> None:
        """Rename entries, here and in the held losses.

        Args:
            kwargs: names of ``_AcceptedKeys`` and their new keys; None restores the default. The
                reward and the flags are looked for inside "next", with or without that word.
        """
        mine = sorted(field.name for field in fields(self._AcceptedKeys))
        unknown = sorted(set(kwargs) - set(mine))
        if unknown:
            raise ValueError(f"{unknown} are no keys of DRBPNLoss; it accepts {mine}.")
        for name in ("reward", "done", "terminated"):
            if kwargs.get(name) is not None:
                kwargs[name] = _without_next(kwargs[name])
        for part in (self.ppo_loss, self.model_loss):
            if part is not None:
                accepted = {field.name for field in fields(part.default_keys)}
                part.set_keys(**{name: kwargs[name] for name in kwargs if name in accepted})
        super().set_keys(**kwargs)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries read: the belief module's, its next step's, the heads' own, those of PPO."""
        # The held loss's own keys, not `tensor_keys`: `dispatch` reads in_keys while it compiles.
        keys, belief = self.ppo_loss.tensor_keys, list(self.filter_network.in_keys)
        actor, critic = self.ppo_loss.actor_network, self.ppo_loss.critic_network
        heads = [*actor.in_keys, *([] if critic is None else critic.in_keys)]
        written = {unravel_key(key) for key in (*self.filter_network.out_keys, *actor.out_keys)}
        model: list[NestedKey] = []
        if self.model_loss is not None:
            made = in_next(self.model_loss.tensor_keys.log_likelihood)
            model = [key for key in self.model_loss.in_keys if key != made]
        own = (keys.action, keys.sample_log_prob, keys.advantage, keys.value_target)
        # A head may read more than features, as a critic that sees what the actor does not.
        read = (*belief, *map(in_next, belief), *heads, *model)
        given = [key for key in map(unravel_key, read) if key not in written]
        return list(dict.fromkeys([*given, *map(unravel_key, own)]))

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries written: the PPO loss's and the model loss's."""
        model = [] if self.model_loss is None else self.model_loss.out_keys
        return [*self.ppo_loss.out_keys, *model]

    @property
    def reduction(self) -> str:
        """How the terms of each step are reduced: "mean", "sum" or "none"."""
        return str(self.ppo_loss.reduction)

    @reduction.setter
    def reduction(self, value: Literal["none", "mean", "sum"]) -> None:
        self.ppo_loss.reduction = value
        if self.model_loss is not None:
            self.model_loss.reduction = value

    @property
    def actor_network(self) -> TensorDictSequential:
        """The policy: the belief module, then the actor."""
        return TensorDictSequential(self.filter_network, self.ppo_loss.actor_network)

    @property
    def critic_network(self) -> TensorDictSequential:
        """The belief module, then the critic, over whole sequences as an estimator calls it."""
        return _OverSequences(self.filter_network, self.ppo_loss.critic_network)

    @property
    def actor_network_params(self) -> TensorDictParams | None:
        """Parameters of ``actor_network``; None if the held PPO loss isn't functional."""
        return self._params(self.actor_network)

    @property
    def critic_network_params(self) -> TensorDictParams | None:
        """Parameters of ``critic_network``; None if the held PPO loss isn't functional."""
        return self._params(self.critic_network)

    def _params(self, network: TensorDictModuleBase) -> TensorDictParams | None:
        return TensorDict.from_module(network, as_module=True) if self.functional else None

    @property
    def functional(self) -> bool:
        """Whether the parameters are swapped in at every call, as in the held PPO loss."""
        return bool(self.ppo_loss.functional)

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: Any
    ) -> Self:
        """Build TorchRL's estimator of advantages, GAE by default, over ``critic_network``."""
        if isinstance(value_type or self.default_value_estimator, ValueEstimators):
            hyperparams = {"deactivate_vmap": True, **hyperparams}
        # PPO's own method, which reads the networks and the keys of the loss that it is given
        ClipPPOLoss.make_value_estimator(self, value_type, **hyperparams)
        return self

    @property
    def value_estimator(self) -> ValueEstimatorBase:
        """The estimator of advantages, by the names that the entries have in the held losses."""
        estimator: ValueEstimatorBase = LossModule.value_estimator.fget(self)
        known = {field.name for field in fields(estimator.default_keys)}
        keys = {name: key for name, key in vars(self.tensor_keys).items() if name in known}
        estimator.set_keys(**keys)
        return estimator

    @value_estimator.setter
    def value_estimator(self, value: ValueEstimatorBase | None) -> None:
        LossModule.value_estimator.fset(self, value)

    def reset_parameters_recursive(self) -> None:
        """Put every parameter back to where a new module starts, the held losses' too."""
        super().reset_parameters_recursive()
        self.ppo_loss.reset_parameters_recursive()

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the PPO terms, ``loss_model`` (weighted), and the metrics of both."""
        advantage = self.ppo_loss.tensor_keys.advantage
        if tensordict.get(advantage, None) is None:
            raise KeyError(
                f"`{advantage}` is not in the tensordict: compute advantages over the whole "
                "rollout first (TorchRL's GAE), then cut it into minibatches."
            )
        data, params = tensordict.clone(False), self.filter_network_params
        with (
            nullcontext()
            if params is None
            else params.to_module(self.filter_network, preserve_module_state=False)
        ):
            self.filter_network(data)
            if self.model_loss is not None:
                self._add_last_observations(data, self.model_loss)
        read = data
        if self.detach_belief:
            belief = data.select(*self.filter_network.out_keys, strict=False).detach()
            read = data.copy().update(belief)
        out: TensorDictBase = self.ppo_loss(read)
        if self.model_loss is not None:
            model = self.model_loss(data)
            model.set("loss_model", self.model_coeff * model.get("loss_model"))
            out.update(model)
        return out

    def _add_last_observations(self, data: TensorDictBase, model_loss: BeliefModelLoss) -> None:
        """Write the likelihood of the next observation where no other step holds it."""
        keys, following = model_loss.tensor_keys, data.get("next", None)
        if following is None or following.get(keys.observed, None) is None:
            return  # without a next step nothing is added
        last = model_loss.last_steps(data)
        # a pass over all would cost as much as the filter; compiled, the number must not vary
        if torch.compiler.is_compiling():
            index = torch.unravel_index(torch.arange(last.numel(), device=last.device), last.shape)
        else:
            index = last.nonzero(as_tuple=True)
        if not len(index[0]):
            return  # not every belief module takes an empty batch
        belief_keys = self.filter_network.in_keys
        # sequences of one step that continue their episode
        alone = tuple(x.unsqueeze(-1) for x in index)
        steps = following.select(*belief_keys, strict=False)[alone]
        goes_on = torch.zeros(*steps.shape, 1, dtype=torch.bool, device=last.device)
        steps.set(self._own_keys.is_init, goes_on)
        self.filter_network(steps)
        found = steps.get(keys.log_likelihood)
        everywhere = found.new_zeros(last.shape).index_put(alone, found)
        data.set(in_next(keys.log_likelihood), everywhere)


class _OverSequences(TensorDictSequential):
    """Modules over whole sequences, however their recurrent mode is set elsewhere."""

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        with set_recurrent_mode(True):
            return super().forward(*args, **kwargs)


def _without_next(key: NestedKey) -> NestedKey:
    key = unravel_key(key)
    return unravel_key(key[1:]) if isinstance(key, tuple) and key[0] == "next" else key
