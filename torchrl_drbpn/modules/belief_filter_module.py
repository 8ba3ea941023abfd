"""The belief filter with TensorDict keys, in the place of TorchRL's GRUModule."""

from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_drbpn.functional import innovation
from torchrl_drbpn.functional.gaussian import tril_to_vector, without_autocast
from torchrl_drbpn.modules.belief_filter import BeliefFilter
from torchrl_drbpn.modules.recurrent_belief import Keys, RecurrentBeliefModule

_DEFAULT = ("features", ("belief", "mean"), ("belief", "log_likelihood"))
_OPTIONAL = tuple(
    ("belief", name) for name in ("cov", "observation", "predicted_observation", "innovation_cov")
)


class BeliefFilterModule(RecurrentBeliefModule):
    """Read what arrived, write the belief: a :class:`BeliefFilter` with keys.

    It takes the place of a ``GRUModule`` in a TorchRL pipeline: one step at a time by default,
    whole trajectories (last batch dimension = time) under ``set_recurrent_mode(True)``, its
    primer found by ``get_primers_from_module``.

    The recurrent state is ``("recurrent", "mean")``, the filtered mean of the step before,
    ``("recurrent", "cov")`` beside it if the filter propagates its covariance, and
    ``("recurrent", "age")``, the updates since the reset. One step at a time ``is_init`` starts
    from the learned initial belief. Over trajectories ``is_init & (age == 0)`` does; where
    ``is_init`` comes with an older age (the "next" stream of ``GAE(shifted=False)``, slices of a
    replay buffer) the stored state is taken. Without any recurrent entry every row starts from
    the initial belief, with one warning.

    Args:
        filter: the filter.
        in_key, out_key: the key of the observation, of the features, when every other keeps its
            name.
        in_keys: the entries read, in the order ``observation, observed, previous_action, is_init,
            ("recurrent", "mean"), ("recurrent", "cov") where there is one, ("recurrent", "age")``:
            a list of the first four or of all, or a dict from these names to yours. None in the
            place of ``observed``: everything arrives; of ``previous_action``: zeros.
        out_keys: the entries written, a list chosen from ``features``, ``("belief", "mean")``,
            ``("belief", "log_likelihood")`` (the default) and, computed only where asked for,
            ``("belief", "cov")``, ``("belief", "observation")`` (H m + B a + d of the filtered
            mean: every sensor's estimate), ``("belief", "predicted_observation")``,
            ``("belief", "innovation_cov")`` (float64); or a dict from these names to yours. The
            recurrent state is always written, under ``("next", ...)``.
        policy_input: what ``features`` holds, for policy and value to read (eq. 11 [DRBPN]):
            "mean", or "mean_cov" (lower triangle of the filtered covariance behind the mean).
        default_recurrent_mode: the mode outside any ``set_recurrent_mode`` context.

    Raises:
        TypeError: if keys are neither a list nor a dict.
        ValueError: for keys that are too few, unknown or given twice, or an unknown choice.
        KeyError: at a call, if an entry is absent; the message says who writes it.

    Example:
        >>> from tensordict import TensorDict
        >>> module = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
        >>> state = {"mean": torch.zeros(3, 5), "age": torch.zeros(3, 1).long()}
        >>> data = TensorDict(
        ...     observation=torch.randn(3, 5), observed=torch.rand(3, 5) < 0.7, recurrent=state,
        ...     previous_action=torch.zeros(3, 2), is_init=torch.ones(3, 1) > 0, batch_size=[3])
        >>> module(data)["features"].shape, data["next", "recurrent", "age"].flatten().tolist()
        (torch.Size([3, 5]), [1, 1, 1])
    """

    filter: BeliefFilter

    def __init__(
        self,
        filter: BeliefFilter,
        *,
        in_key: NestedKey | None = None,
        in_keys: Keys = None,
        out_key: NestedKey | None = None,
        out_keys: Keys = None,
        policy_input: Literal["mean", "mean_cov"] = "mean",
        default_recurrent_mode: bool | None = None,
    ) -> None:
        if policy_input not in ("mean", "mean_cov"):
            raise ValueError(f"`policy_input` must be 'mean' or 'mean_cov', got {policy_input!r}.")
        state: dict[NestedKey, tuple[int, ...]] = {("recurrent", "mean"): (filter.state_dim,)}
        if filter.covariance == "propagated":
            state["recurrent", "cov"] = (filter.state_dim, filter.state_dim)
        super().__init__(
            filter, state, _DEFAULT, _OPTIONAL, in_key, in_keys, out_key, out_keys,
            default_recurrent_mode,
        )  # fmt: skip
        self.policy_input = policy_input

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the belief; see the class for keys and modes."""
        with without_autocast(self.filter.initial_mean):
            return self._write_belief(tensordict)

    def _write_belief(self, tensordict: TensorDictBase) -> TensorDictBase:
        given = self._read(tensordict)
        mean, cov = given.state[0], given.state[1] if len(given.state) > 1 else None
        readings = (given.previous_action, given.observation, given.observed, given.reset)
        want_cov = ("belief", "cov") in self._out or self.policy_input == "mean_cov"
        if not self.recurrent_mode:
            out = self.filter.step(mean, cov, *readings, return_cov=want_cov)
        else:
            time = given.reset.ndim - 1

            def first(x: Tensor) -> Tensor:  # zeros if there is no time
                return x.select(time, 0) if x.shape[time] else x.sum(time)

            out = self.filter(
                first(mean), None if cov is None else first(cov), *readings,
                use_stored_state=given.use_stored_state, stored_mean=mean, stored_cov=cov,
                return_cov=want_cov,
            )  # fmt: skip
        features = out.mean
        if self.policy_input == "mean_cov" and out.cov is not None:
            features = torch.cat([out.mean, tril_to_vector(out.cov)], -1)
        results: dict[NestedKey, Tensor | None] = {
            "features": features,
            ("belief", "mean"): out.mean,
            ("belief", "log_likelihood"): out.log_likelihood,
            ("belief", "cov"): out.cov,
        }
        if any(name not in results for name in self._out):
            if self.recurrent_mode:
                mean = _before(mean, out.mean, given.use_stored_state)
                if cov is not None and out.cov is not None:
                    cov = _before(cov, out.cov, given.use_stored_state)
            emission, action = self.filter.emission, given.previous_action
            predicted = self.filter.predict(mean, action, given.reset, cov)
            results["belief", "observation"] = emission(out.mean, action)
            results["belief", "predicted_observation"] = emission(predicted.mean, action)
            if ("belief", "innovation_cov") in self._out:
                H, R = emission.affine()[0], emission.cov()
                compared = innovation(predicted, given.observation, given.observed, H, R)
                results["belief", "innovation_cov"] = compared.cov
        after = [out.mean] if cov is None or out.cov is None else [out.mean, out.cov]
        return self._write(tensordict, results, (*after, given.age + 1))

    @property
    def feature_dim(self) -> int:
        """Width of ``features``, for building the heads that read it."""
        state = self.filter.state_dim
        return state if self.policy_input == "mean" else state + state * (state + 1) // 2


def _before(stored: Tensor, filtered: Tensor, use_stored: Tensor) -> Tensor:
    """Return what each step of a sequence started from: what is stored, or the step before."""
    time = use_stored.ndim - 1
    steps = filtered.shape[time]
    previous = (stored.narrow(time, 0, min(1, steps)), filtered.narrow(time, 0, max(0, steps - 1)))
    use = use_stored.reshape(*use_stored.shape, *(1,) * (stored.ndim - use_stored.ndim))
    return torch.where(use, stored, torch.cat(previous, time))
