"""The particle filter with TensorDict keys and the manners of TorchRL's GRUModule."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torchrl_drbpn.functional import effective_sample_size
from torchrl_drbpn.modules._keys import read_entry, read_in_keys, read_out_keys
from torchrl_drbpn.modules.belief_filter_module import _steps_since
from torchrl_drbpn.modules.particle_model import ParticleFilter

__all__ = ["ParticleFilterModule"]

IN_KEYS: tuple[NestedKey, ...] = (
    "observation",
    "observed",
    "previous_action",
    "is_init",
    ("recurrent", "particles"),
    ("recurrent", "log_weight"),
    ("recurrent", "age"),
)
DEFAULT_OUT_KEYS: tuple[NestedKey, ...] = ("features", ("belief", "log_likelihood"))
OPTIONAL_OUT_KEYS: tuple[NestedKey, ...] = (
    ("belief", "observation"),
    ("belief", "latent"),
    ("belief", "effective_sample_size"),
)


class ParticleFilterModule(TensorDictModuleBase):
    r"""Read what arrived, write features of particles: a :class:`ParticleFilter` with keys.

    Deep variational reinforcement learning [DVRL 2018] in the place of a ``GRUModule`` or a
    :class:`~torchrl_drbpn.BeliefFilterModule`: one step at a time by default, whole trajectories
    (last batch dimension = time) under ``set_recurrent_mode(True)``, its primer found by
    ``get_primers_from_module``. ``("belief", "log_likelihood")`` is the log of the particles'
    mean weight, so :class:`~torchrl_drbpn.BeliefModelLoss` of it is minus the evidence lower
    bound, and :class:`~torchrl_drbpn.DRBPNLoss` serves unchanged.

    The recurrent state is what every particle remembers, ``("recurrent", "particles")``, their
    weights, ``("recurrent", "log_weight")``, and ``("recurrent", "age")``, the updates since the
    reset. Particles start from zeros where ``is_init & (age == 0)``; where ``is_init`` comes with
    an older age (the "next" stream of ``GAE(shifted=False)``, slices of a replay buffer) the
    stored state is taken. Without recurrent entries every row starts from zeros; one step at a
    time so does every step, with one warning.

    The filter is random, and yet a step gives the same particles wherever it is computed, so that
    PPO's ratio is 1 before the first update: see :meth:`ParticleFilter.noise`.

    Args:
        filter: the filter.

    Keyword Args:
        in_keys: the seven entries read, in the order ``observation, observed, previous_action,
            is_init, ("recurrent", "particles"), ("recurrent", "log_weight"),
            ("recurrent", "age")``: a list of the first four or of all seven, or a dict from these
            names to yours.
        out_keys: the entries written, a list chosen from ``features``,
            ``("belief", "log_likelihood")`` (the default) and, only where asked for,
            ``("belief", "observation")`` (the emission's mean, averaged over the particles: every
            sensor's estimate), ``("belief", "latent")`` (z of every particle),
            ``("belief", "effective_sample_size")``; or a dict from these names to yours. The
            recurrent state is always written, under ``("next", ...)``.
        default_recurrent_mode: the mode outside any ``set_recurrent_mode`` context.

    Raises:
        ValueError: for a key list of another length or an unknown name.
        KeyError: if an entry it reads is not in the tensordict.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> filter = ParticleFilter(5, 2, num_particles=4, hidden_dim=8, latent_dim=3)
        >>> module = ParticleFilterModule(filter)
        >>> data = TensorDict(
        ...     observation=torch.randn(3, 10, 5),
        ...     observed=torch.rand(3, 10, 5) < 0.7,
        ...     previous_action=torch.zeros(3, 10, 2),
        ...     is_init=torch.zeros(3, 10, 1, dtype=torch.bool),
        ...     batch_size=[3, 10])
        >>> with set_recurrent_mode(True):
        ...     out, again = module(data.clone()), module(data)
        >>> out["features"].shape, bool((out["features"] == again["features"]).all())
        (torch.Size([3, 10, 8]), True)
    """

    def __init__(
        self,
        filter: ParticleFilter,
        *,
        in_keys: Sequence[NestedKey] | Mapping[NestedKey, NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | Mapping[NestedKey, NestedKey] | None = None,
        default_recurrent_mode: bool | None = None,
    ) -> None:
        super().__init__()
        self.filter = filter
        self._default_recurrent_mode = default_recurrent_mode
        self._warned = False
        self.in_keys = read_in_keys(in_keys, IN_KEYS, "the particle filter")
        self._next = [unravel_key(("next", key)) for key in self.in_keys[4:]]
        self._out = read_out_keys(
            out_keys, DEFAULT_OUT_KEYS, OPTIONAL_OUT_KEYS, self._next, "the particle filter"
        )
        self.out_keys = [*self._out.values(), *self._next]

    # ------------------------------------------------------------------ forward
    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write features and likelihood; see the class for keys and modes."""
        observation, observed, action, is_init = (
            read_entry(tensordict, self.in_keys, i) for i in range(4)
        )
        # Simulators take float32 actions beside float64 observations; a cast loses nothing there.
        action = action.to(self.filter.proposal.weight.dtype)
        first = is_init.squeeze(-1)
        sequence = self.recurrent_mode
        if sequence and first.ndim == 0:
            raise ValueError(
                "under set_recurrent_mode(True) the last batch dimension is time, but the input "
                "has no batch dimension at all."
            )
        particles, log_weight, age = (tensordict.get(key, None) for key in self.in_keys[4:])
        if particles is None or log_weight is None or age is None:
            particles, log_weight, age, first = self._fresh_state(observation, first, sequence)
        reset = first & (age.squeeze(-1) == 0)
        particles = torch.where(reset[..., None, None], 0.0, particles)
        log_weight = torch.where(reset[..., None], 0.0, log_weight)

        noise = self.filter.noise(action, observation, observed, age)
        if sequence:
            # At an is_init with an older age the row is stitched: take the stored state there.
            out = self.filter(particles, log_weight, first, action, observation, observed, noise)
        else:
            out = self.filter.step(particles, log_weight, action, observation, observed, noise)

        for key, value in zip(self._next, (out.hidden, out.log_weight, age + 1), strict=True):
            tensordict.set(key, value)
        for name, key in self._out.items():
            if name == "features":
                value = self.filter.features(out)
            elif name == ("belief", "log_likelihood"):
                value = out.log_likelihood
            elif name == ("belief", "observation"):
                weight = out.log_weight.softmax(-1).unsqueeze(-1)
                value = (weight * out.expected).sum(-2)
            elif name == ("belief", "latent"):
                value = out.latent
            else:
                value = effective_sample_size(out.log_weight)
            tensordict.set(key, value)
        return tensordict

    def _fresh_state(
        self, observation: Tensor, first: Tensor, sequence: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Make the state of rows that bring none: they start from zeros."""
        count = self.filter.num_particles
        particles = observation.new_zeros(*first.shape, count, self.filter.hidden_dim)
        log_weight = observation.new_zeros(*first.shape, count)
        if sequence:
            first = torch.cat([torch.ones_like(first[..., :1]), first[..., 1:]], -1)
            return particles, log_weight, _steps_since(first), first
        if not self._warned and not torch.compiler.is_compiling():
            self._warned = True
            warnings.warn(
                f"`{self.in_keys[4]}` is not in the tensordict, so every step starts an episode "
                "and nothing is remembered. Append make_tensordict_primer() to the environment, "
                "or collect with auto_register_policy_transforms=True.",
                stacklevel=2,
            )
        age = torch.zeros(*first.shape, 1, dtype=torch.int64, device=first.device)
        return particles, log_weight, age, torch.ones_like(first)

    @property
    def feature_dim(self) -> int:
        """Width of ``features``, for building the heads that read it."""
        return self.filter.hidden_dim

    # ------------------------------------------------------------------ modes and primer
    @property
    def recurrent_mode(self) -> bool:
        """Whether the last batch dimension is read as time."""
        mode = recurrent_mode()
        return bool(self._default_recurrent_mode) if mode is None else mode

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that puts the recurrent state into the environment.

        Returns:
            A primer of zeros for particles ``(particles, hidden)``, log-weights ``(particles,)``
            and age ``(1,)``: an episode starts from zeros, all particles alike.

        Example:
            >>> filter = ParticleFilter(5, 2, num_particles=4, hidden_dim=8, latent_dim=3)
            >>> primer = ParticleFilterModule(filter).make_tensordict_primer()
            >>> primer.primers["recurrent", "particles"].shape
            torch.Size([4, 8])
        """
        weight = self.filter.proposal.weight
        shape = (self.filter.num_particles, self.filter.hidden_dim)
        particles, log_weight, age = self.in_keys[4:]
        return TensorDictPrimer(
            {
                particles: Unbounded(shape, dtype=weight.dtype),
                log_weight: Unbounded(shape[:1], dtype=weight.dtype),
                age: Unbounded((1,), dtype=torch.int64),
            },
            expand_specs=True,
        )
