"""The particle filter with TensorDict keys, in the place of TorchRL's GRUModule."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey

from torchrl_drbpn.modules.particle_model import ParticleFilter
from torchrl_drbpn.modules.recurrent_belief import Keys, RecurrentBeliefModule

_DEFAULT = ("features", ("belief", "log_likelihood"))
_OPTIONAL = tuple(("belief", n) for n in ("observation", "latent", "effective_sample_size"))


class ParticleFilterModule(RecurrentBeliefModule):
    """Read what arrived, write features of particles: a :class:`ParticleFilter` with keys.

    Deep variational reinforcement learning [DVRL 2018] in the place of a ``GRUModule`` or a
    :class:`~torchrl_drbpn.BeliefFilterModule`, whose arguments, errors and rules for modes and
    recurrent state hold here too. ``("belief", "log_likelihood")`` is the log of the particles'
    mean weight: :class:`~torchrl_drbpn.BeliefModelLoss` of it is minus the evidence lower bound. A
    step gives the same particles wherever it is computed: see :meth:`ParticleFilter.noise`.

    Args:
        filter: the filter.
        in_keys: ``("recurrent", "particles"), ("recurrent", "log_weight")`` take the place of
            ``("recurrent", "mean")``: a list has four or seven entries.
        out_keys: chosen from ``features``, ``("belief", "log_likelihood")`` (the default) and, only
            where asked for, ``("belief", "observation")`` (the emission's mean, averaged over the
            particles: every sensor's estimate), ``("belief", "latent")`` (z of every particle),
            ``("belief", "effective_sample_size")``.

    Example:
        >>> from tensordict import TensorDict
        >>> filter = ParticleFilter(5, 2, num_particles=4, hidden_dim=8, latent_dim=3)
        >>> module, state = ParticleFilterModule(filter), dict(particles=torch.zeros(3, 4, 8))
        >>> state |= dict(log_weight=torch.zeros(3, 4), age=torch.zeros(3, 1).long())
        >>> data = TensorDict(
        ...     observation=torch.randn(3, 5), observed=torch.rand(3, 5) < 0.7, recurrent=state,
        ...     previous_action=torch.zeros(3, 2), is_init=torch.ones(3, 1) > 0, batch_size=[3])
        >>> out, again = module(data.clone()), module(data)
        >>> out["features"].shape, torch.equal(out["features"], again["features"])
        (torch.Size([3, 8]), True)
    """

    filter: ParticleFilter

    def __init__(
        self,
        filter: ParticleFilter,
        *,
        in_key: NestedKey | None = None,
        in_keys: Keys = None,
        out_key: NestedKey | None = None,
        out_keys: Keys = None,
        default_recurrent_mode: bool | None = None,
    ) -> None:
        count = filter.num_particles
        state = {
            ("recurrent", "particles"): (count, filter.hidden_dim),
            ("recurrent", "log_weight"): (count,),
        }
        super().__init__(
            filter, state, _DEFAULT, _OPTIONAL,
            in_key, in_keys, out_key, out_keys, default_recurrent_mode,
        )  # fmt: skip

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write features and likelihood; see the class for keys and modes."""
        given = self._read(tensordict)
        particles, log_weight = given.state
        particles = torch.where(given.reset[..., None, None], 0.0, particles)
        log_weight = torch.where(given.reset[..., None], 0.0, log_weight)
        inputs = (given.previous_action, given.observation, given.observed)
        noise = self.filter.noise(*inputs, given.age)
        if self.recurrent_mode:
            begin = given.reset | given.use_stored_state
            out = self.filter(particles, log_weight, begin, *inputs, noise)
        else:
            out = self.filter.step(particles, log_weight, *inputs, noise)
        weight = out.log_weight.softmax(-1).unsqueeze(-1)
        results = {
            "features": self.filter.features(out),
            ("belief", "log_likelihood"): out.log_likelihood,
            ("belief", "observation"): (weight * out.expected).sum(-2),
            ("belief", "latent"): out.latent,
            ("belief", "effective_sample_size"): 1.0 / weight.square().sum((-2, -1)),
        }
        return self._write(tensordict, results, (out.hidden, out.log_weight, given.age + 1))

    @property
    def feature_dim(self) -> int:
        """Width of ``features``, for building the heads that read it."""
        return self.filter.hidden_dim
