"""What belief modules share with TorchRL's GRUModule: keys, mode, recurrent state, primer."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torchrl_drbpn.modules.belief_filter import BeliefFilter
from torchrl_drbpn.modules.particle_model import ParticleFilter

Keys = Sequence[NestedKey | None] | Mapping[NestedKey, NestedKey | None] | None

_AGE = ("recurrent", "age")
# What is read beside the recurrent state, and what to do if it is absent.
_SOURCES = {
    "observation": "does the environment use another name? Pass in_keys",
    "observed": "ObservationMissingness or ObservedFromNaN writes it; in_keys={'observed': None} "
    "says that everything arrives",
    "previous_action": "the PreviousAction transform writes it; in_keys={'previous_action': None} "
    "stands for zeros",
    "is_init": "TorchRL's InitTracker transform writes it",
}
_MAY_BE_NONE = ("observed", "previous_action")


class _Inputs(NamedTuple):
    """What one call reads; over trajectories time is the last dimension of batch."""

    observation: Tensor  # (*batch, obs)
    observed: Tensor  # bool, (*batch, obs)
    previous_action: Tensor  # (*batch, action)
    reset: Tensor  # bool, (*batch,): start from the initial belief
    use_stored_state: Tensor  # bool, (*batch,): take the state stored at this step
    state: list[Tensor]  # the recurrent entries but the age
    age: Tensor  # updates since the reset, before this one, int64, (*batch, 1)


class RecurrentBeliefModule(TensorDictModuleBase):
    """Give a filter keys, a recurrent mode, a primer and the rule of what a step starts from.

    ``state`` are the recurrent entries but the age, from name to shape; ``outputs`` are written by
    default, features first; ``optional`` where asked for. For the rest see
    :class:`~torchrl_drbpn.BeliefFilterModule`.
    """

    def __init__(
        self,
        filter: BeliefFilter | ParticleFilter,
        state: Mapping[NestedKey, tuple[int, ...]],
        outputs: Sequence[NestedKey],
        optional: Sequence[NestedKey],
        in_key: NestedKey | None,
        in_keys: Keys,
        out_key: NestedKey | None,
        out_keys: Keys,
        default_recurrent_mode: bool | None,
    ) -> None:
        super().__init__()
        self.filter = filter
        self._default_recurrent_mode, self._warned = default_recurrent_mode, False
        for name, one, several in (("in_key", in_key, in_keys), ("out_key", out_key, out_keys)):
            if one is not None and several is not None:
                raise ValueError(f"`{name}` and `{name}s` were both given: pass one of them.")
        names = (*_SOURCES, *state, _AGE)
        if in_key is not None:
            in_keys = {"observation": in_key}
        elif in_keys is not None and not isinstance(in_keys, Mapping):
            listed = as_keys("in_keys", in_keys)
            if len(listed) not in (len(_SOURCES), len(names)):
                raise ValueError(
                    f"`in_keys` must have {len(_SOURCES)} or {len(names)} entries, in the order "
                    f"{list(names)}, got {listed}. To rename one of them pass a dict such as "
                    "{'observation': 'pixels_encoded'}."
                )
            in_keys = dict(zip(names, listed, strict=False))
        self._in = {name: name for name in names} | _renamed("in_keys", in_keys or {}, names)
        nameless = [n for n, key in self._in.items() if key is None and n not in _MAY_BE_NONE]
        if nameless:
            raise ValueError(f"`in_keys` must name {nameless}; only {_MAY_BE_NONE} may be None.")

        self._state = {self._in[name]: shape for name, shape in {**state, _AGE: (1,)}.items()}
        self._next = [unravel_key(("next", key)) for key in self._state]
        if out_keys is None:
            out_keys = {name: name for name in outputs} | {
                outputs[0]: outputs[0] if out_key is None else out_key
            }
        elif not isinstance(out_keys, Mapping):
            listed = as_keys("out_keys", out_keys)
            out_keys = {key: key for key in listed if key not in self._next}
        self._out = _renamed("out_keys", out_keys, (*outputs, *optional))
        self.in_keys = [key for key in self._in.values() if key is not None]
        self.out_keys = [*self._out.values(), *self._next]
        for name, keys in (("in_keys", self.in_keys), ("out_keys", self.out_keys)):
            twice = ", ".join(sorted({str(key) for key in keys if keys.count(key) > 1}))
            if twice:
                raise ValueError(f"`{name}` must give every entry a key of its own: {twice} twice.")

    def _read(self, tensordict: TensorDictBase) -> _Inputs:
        """Read the inputs and the state that each step starts from."""
        found: dict[str, Any] = {}
        for name, remedy in _SOURCES.items():
            key = self._in[name]
            found[name] = None if key is None else tensordict.get(key, None)
            if key is not None and found[name] is None:
                raise KeyError(f"`{key}` is not in the tensordict: {remedy}.")
        x, observed, action, first = found.values()
        first = first.squeeze(-1) if first.ndim == x.ndim else first
        if observed is None:
            observed = torch.ones_like(x, dtype=torch.bool)
        if action is None:
            action = x.new_zeros(*first.shape, self.filter.action_dim)
        # Simulators take float32 actions beside float64 observations; a cast loses nothing there.
        inputs = (x, observed, action.to(self.dtype))
        sequence = self.recurrent_mode
        if sequence and first.ndim == 0:
            raise ValueError(
                "under set_recurrent_mode(True) the last batch dimension is time, but the input "
                "has no batch dimension at all."
            )
        stored = {key: tensordict.get(key, None) for key in self._state}
        absent = [key for key, value in stored.items() if value is None]
        if absent and len(absent) < len(stored):
            raise KeyError(
                f"`{absent[0]}` is not in the tensordict, while the rest of the recurrent state "
                "is: make_tensordict_primer() writes all of it."
            )
        if absent:
            self._warn_once(absent[0])
            reset = torch.ones_like(first)
            if sequence:
                reset = torch.cat([reset[..., :1], first[..., 1:]], -1)
            state = [x.new_zeros(*first.shape, *s, dtype=self.dtype) for s in self._state.values()]
            age = _steps_since(reset) if sequence else state[-1].long()
            return _Inputs(*inputs, reset, torch.zeros_like(reset), state[:-1], age)
        *state, age = stored.values()
        if not sequence:  # is_init alone resets, as in GRUModule
            age = torch.where(first.unsqueeze(-1), 0, age)
            return _Inputs(*inputs, first, torch.zeros_like(first), state, age)
        # An is_init with an older age is where two slices were joined: the state is stored there.
        reset = first & (age.squeeze(-1) == 0)
        return _Inputs(*inputs, reset, first & ~reset, state, age)

    def _write(
        self,
        tensordict: TensorDictBase,
        results: Mapping[NestedKey, Tensor | None],
        state: Sequence[Tensor],
    ) -> TensorDictBase:
        """Write the results asked for and the state of the next step, its age last."""
        for key, value in zip(self._next, state, strict=True):
            tensordict.set(key, value)
        for name, key in self._out.items():
            tensordict.set(key, results[name])
        return tensordict

    def _warn_once(self, key: NestedKey) -> None:
        if not self._warned and not torch.compiler.is_compiling():
            self._warned = True
            warnings.warn(
                f"`{key}` is not in the tensordict: every row starts from the initial belief, and "
                "one step at a time nothing is remembered. Append make_tensordict_primer() to the "
                "environment, or collect with auto_register_policy_transforms=True.",
                stacklevel=5,  # the caller of this package
            )

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the filter's parameters."""
        # By name: value estimators swap in detached tensors, which parameters() does not list.
        filter = self.filter
        like = filter.initial_mean if isinstance(filter, BeliefFilter) else filter.noise_table
        return like.dtype

    @property
    def recurrent_mode(self) -> bool:
        """Whether the last batch dimension is read as time."""
        mode = recurrent_mode()
        return bool(self._default_recurrent_mode) if mode is None else mode

    @property
    def canonical_keys(self) -> list[NestedKey]:
        """Keys that ``torchrl.modules.canonicalize_rnn_subset`` makes contiguous."""
        return [*self.in_keys, *self.out_keys]

    def canonicalize(self, data: TensorDictBase, *, inplace: bool = False) -> TensorDictBase:
        """Make this module's entries contiguous where they are there; others keep their memory."""
        part = data.select(*self.canonical_keys, strict=False).contiguous()
        return (data if inplace else data.copy()).update(part)

    def reset_parameters(self) -> None:
        """Draw the filter's parameters anew."""
        self.filter.reset_parameters()

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that puts the recurrent state, zeros, into the environment.

        Example:
            >>> from torchrl_drbpn import BeliefFilter, BeliefFilterModule
            >>> primer = BeliefFilterModule(BeliefFilter(5, 2)).make_tensordict_primer()
            >>> ("recurrent", "mean") in primer.primers.keys(True)
            True
        """
        # No device: an environment that has one moves the primer to it, one without resets on the
        # CPU, whatever the policy runs on.
        specs = {key: Unbounded(shape, dtype=self.dtype) for key, shape in self._state.items()}
        specs[self._in[_AGE]] = Unbounded((1,), dtype=torch.int64)
        return TensorDictPrimer(specs, expand_specs=True)


def as_keys(argument: str, given: Sequence[NestedKey | None]) -> list[NestedKey | None]:
    """Return a list of keys; a key may be any sequence of strings, as configurations give them."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise TypeError(
            f"`{argument}` must be a list of keys or a dict, got {given!r} of type "
            f"{type(given).__name__}."
        )
    return [
        key if key is None else unravel_key(key if isinstance(key, str) else tuple(key))
        for key in given
    ]


def _renamed(
    argument: str, given: Mapping[NestedKey, NestedKey | None], names: Sequence[NestedKey]
) -> dict[NestedKey, NestedKey | None]:
    """Return the map from canonical names to the user's keys; refuse unknown names."""
    listed = (as_keys(argument, list(part)) for part in (given, given.values()))
    pairs = dict(zip(*listed, strict=True))
    unknown = [name for name in pairs if name not in names]
    if unknown:
        raise ValueError(
            f"`{argument}` names {unknown}, none of {list(names)}. To use other keys pass a dict "
            "from these names to yours; the recurrent state, always written, is renamed by in_keys."
        )
    return pairs


def _steps_since(begins: Tensor) -> Tensor:
    """Count the steps since the last beginning in each row, shape (*batch, time, 1)."""
    index = torch.arange(begins.shape[-1], device=begins.device).expand(begins.shape)
    return (index - torch.where(begins, index, 0).cummax(-1).values).unsqueeze(-1)
