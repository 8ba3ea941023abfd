"""DRBPN's loss: PPO on beliefs plus the model's likelihood, from one filter pass."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import ValueEstimators

from torchrl_drbpn.modules import BeliefFilter, BeliefFilterModule
from torchrl_drbpn.objectives._clipped import plain_heads, plain_terms
from torchrl_drbpn.objectives._filtered import filtered_terms
from torchrl_drbpn.objectives.belief_model import BeliefModelLoss, following_keys, last_steps

__all__ = ["DRBPNLoss"]


class DRBPNLoss(LossModule):
    r"""Run the belief module once, then the PPO loss and the model loss on what it wrote.

    .. math:: L = L^{objective} + \lambda_v L^{critic} + \lambda_m L^{model}

    Eq. (13) [DRBPN]: one pass, and all gradients reach the filter. The two losses are held, not
    subclassed; the actor and the critic of ``ppo_loss`` are heads that read what the belief
    module writes (``features``). ``loss_model`` comes out weighted by ``model_coeff``, as
    ``loss_critic`` does by its coefficient, so the sum of all ``loss_*`` is the total.

    The input is a batch of sequences, ``[*batch, time]``, cut from rollouts, with the stored
    recurrent state: each sequence starts from the belief the collector stored there. Where an
    episode ends, or ``final`` says that the rollout was cut, the next observation's likelihood
    is added by one more step of the belief module.

    Args:
        filter_module: a belief module, such as :class:`~torchrl_drbpn.BeliefFilterModule`.
        ppo_loss: TorchRL's ClipPPOLoss over heads.
        model_loss: the model loss, None for belief modules without a likelihood.

    Keyword Args:
        model_coeff: lambda_m, at least 0; ``loss.model_coeff = 0.3`` changes it in place.
        detach_belief: keep PPO's gradient out of the filter.
        functional: whether the belief module is functionalised, as in ClipPPOLoss; False spares
            the swapping of its parameters at every call.

    Raises:
        ValueError: for a negative coefficient.
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
    class _AcceptedKeys:
        """Name the entries read; those of the held losses are passed on to them."""

        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        sample_log_prob: NestedKey = "action_log_prob"
        action: NestedKey = "action"
        features: NestedKey = "features"
        log_likelihood: NestedKey = ("belief", "log_likelihood")
        observed: NestedKey = "observed"
        next_log_likelihood: NestedKey = ("next", "belief", "log_likelihood")
        next_observed: NestedKey = ("next", "observed")
        done: NestedKey = ("next", "done")
        final: NestedKey = "final"
        is_init: NestedKey = "is_init"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    filter_network: TensorDictModuleBase
    filter_network_params: TensorDictParams | None
    target_filter_network_params: TensorDictParams
    _schedulable_buffers = frozenset({"model_coeff"})

    def __init__(
        self,
        filter_module: TensorDictModuleBase,
        ppo_loss: ClipPPOLoss,
        model_loss: BeliefModelLoss | None,
        *,
        model_coeff: float = 1.0,
        detach_belief: bool = False,
        functional: bool = True,
    ) -> None:
        super().__init__()
        if model_coeff < 0:
            raise ValueError(f"`model_coeff` must be at least 0, got {model_coeff}.")
        self._functional = functional
        if functional:
            self.convert_to_functional(filter_module, "filter_network")
        else:
            self.filter_network = filter_module
            self.filter_network_params = None
        self.ppo_loss = ppo_loss
        self.model_loss = model_loss
        self.detach_belief = detach_belief
        self.register_coeff_buffer("model_coeff", model_coeff)

    # ------------------------------------------------------------------ keys
    def set_keys(self, **kwargs: Any) -> None:
        """Rename entries, here and in the held losses.

        Args:
            kwargs: names of ``_AcceptedKeys`` and their new keys; None restores the default. A
                ``done`` is looked for inside "next", with or without that word; a next mask is
                called what the mask is unless it is named too.

        Raises:
            ValueError: for an unknown name.
        """
        mine = {f.name for f in fields(self._AcceptedKeys)}
        unknown = sorted(set(kwargs) - mine)
        if unknown:
            raise ValueError(f"{unknown} are no keys of DRBPNLoss; it accepts {sorted(mine)}.")
        kwargs = following_keys(kwargs)
        super().set_keys(**kwargs)
        for part in (self.ppo_loss, self.model_loss):
            if part is not None:
                accepted = {f.name for f in fields(part.default_keys)}
                its = {name: key for name, key in kwargs.items() if name in accepted}
                if part is self.ppo_loss and "done" in its:
                    # PPO names the entry inside "next", the model loss from the root.
                    its["done"] = _inside_next(its["done"])
                part.set_keys(**its)

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Do nothing: the held PPO loss owns the value estimator."""

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries read: the belief module's, its next step's, the heads' own, those of PPO."""
        keys = self.tensor_keys
        belief = list(self.filter_network.in_keys)
        following = [unravel_key(("next", key)) for key in belief]
        written = {unravel_key(key) for key in self.filter_network.out_keys}
        actor, critic = self.ppo_loss.actor_network, self.ppo_loss.critic_network
        # A head may read more than features, as a critic that sees what the actor does not.
        heads = [key for head in (actor, critic) if head is not None for key in head.in_keys]
        made = written | {unravel_key(key) for key in actor.out_keys}
        read = [
            *belief,
            *(key for key in following if key not in written),
            *(key for key in map(unravel_key, heads) if key not in made),
            keys.done,
            keys.final,
            keys.action,
            keys.sample_log_prob,
            keys.advantage,
            keys.value_target,
        ]
        return list(dict.fromkeys(read))

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        del value
        raise RuntimeError("the in_keys follow from the held modules: use set_keys to rename one.")

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries written: the PPO loss's and the model loss's."""
        model = [] if self.model_loss is None else self.model_loss.out_keys
        return [*self.ppo_loss.out_keys, *model]

    @out_keys.setter
    def out_keys(self, value: list[NestedKey]) -> None:
        del value
        raise RuntimeError("the out_keys follow from the held losses.")

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: Any
    ) -> None:
        """Pass on to the PPO loss.

        Args:
            value_type: as in TorchRL's losses.
            hyperparams: of the estimator.
        """
        self.ppo_loss.make_value_estimator(value_type, **hyperparams)

    def reset_parameters_recursive(self) -> None:
        """Put every parameter back to where a new module starts, the held losses' too."""
        super().reset_parameters_recursive()
        self.ppo_loss.reset_parameters_recursive()

    # ------------------------------------------------------------------ forward
    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the PPO terms, ``loss_model`` (weighted), and the metrics of both."""
        keys = self.tensor_keys
        if tensordict.get(keys.advantage, None) is None:
            raise KeyError(
                f"`{keys.advantage}` is not in the tensordict: compute advantages over the whole "
                "rollout first (TorchRL's GAE), then cut it into minibatches."
            )
        plain = self._plain_forward(tensordict)
        if plain is not None:
            return plain
        data = tensordict.copy()
        params = self.filter_network_params
        with (
            nullcontext()
            if params is None
            else params.to_module(self.filter_network, preserve_module_state=False)
        ):
            belief = getattr(self.filter_network, "filter", None)
            # One set of Q, R, H, ... and one gradient of it for both passes.
            with (
                belief.shared_state_space()
                if isinstance(belief, BeliefFilter) and self.model_loss is not None
                else nullcontext()
            ):
                self.filter_network(data)
                if self.model_loss is not None:
                    self._add_last_observations(data)

        model = None if self.model_loss is None else self.model_loss(data)
        if self.detach_belief:
            data.set(keys.features, data.get(keys.features).detach())
        heads = plain_heads(self.ppo_loss, data)
        out = (
            self.ppo_loss(data)
            if heads is None
            else TensorDict(plain_terms(self.ppo_loss, heads, data, {}))
        )
        if model is not None:
            for name, value in model.items():
                out.set(name, self.model_coeff * value if name == "loss_model" else value)
        return out

    def _plain_forward(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Do the same without TensorDicts in between, where everything is of the usual kind."""
        features = self.tensor_keys.features
        heads = plain_heads(self.ppo_loss, tensordict)
        if heads is None or self.filter_network_params is not None:
            return None
        filtered = filtered_terms(self.filter_network, self.model_loss, tensordict)
        if filtered is None or features not in filtered[0]:
            return None
        written, model = filtered
        if self.detach_belief:
            written = {**written, features: written[features].detach()}
        terms = plain_terms(self.ppo_loss, heads, tensordict, written)
        for name, value in model.items():
            terms[name] = self.model_coeff * value if name == "loss_model" else value
        return TensorDict(terms)

    def _add_last_observations(self, data: TensorDictBase) -> None:
        """Write the likelihood of the next observation where no root step holds it.

        Only those few steps are gathered: a masked pass over all of them would factorise twice as
        many matrices as the filter itself.
        """
        keys = self.tensor_keys
        log_likelihood = data.get(keys.log_likelihood, None)
        if log_likelihood is None or data.get(keys.next_observed, None) is None:
            return  # the model loss says what is missing; without a next step nothing is added
        where = last_steps(data, done=keys.done, final=keys.final, like=log_likelihood).nonzero(
            as_tuple=True
        )
        if not where[0].numel():
            return  # no row ends here; not every belief module takes an empty batch
        following = [data.get(("next", key), None) for key in self.filter_network.in_keys]
        next_ll = self._next_log_likelihood([None if x is None else x[where] for x in following])
        data.set(
            keys.next_log_likelihood, torch.zeros_like(log_likelihood).index_put(where, next_ll)
        )

    def _next_log_likelihood(self, following: list[Tensor | None]) -> Tensor:
        """Run the belief module on gathered steps, as sequences of one: they have the fast forms.

        Args:
            following: the entries that the belief module reads, ``(steps, ...)``.

        Returns:
            Shape ``(steps,)``.
        """
        module = self.filter_network
        of_key = {
            key: value.unsqueeze(1)
            for key, value in zip(module.in_keys, following, strict=True)
            if value is not None
        }
        count = len(next(iter(of_key.values())))
        # A belief that goes on is what is wanted here.
        goes_on = torch.zeros(count, 1, dtype=torch.bool, device=self.model_coeff.device)
        if type(module) is BeliefFilterModule and len(of_key) == len(module.in_keys):
            observation, observed, action, _, mean, _ = (of_key[key] for key in module.in_keys)
            action = action.to(mean.dtype)
            out = module.filter(mean[:, 0], None, action, observation, observed, goes_on)
            return out.log_likelihood.squeeze(1)
        gathered = TensorDict(of_key, batch_size=[count, 1])
        gathered.set(self.tensor_keys.is_init, goes_on.unsqueeze(-1))
        module(gathered)
        return gathered.get(self.tensor_keys.log_likelihood).squeeze(1)


def _inside_next(key: NestedKey | None) -> NestedKey | None:
    """Return ``("next", key)`` as PPO names it, without "next"."""
    if isinstance(key, tuple) and key[0] == "next":
        return unravel_key(key[1:])
    return key
