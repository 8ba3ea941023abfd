"""Problems for the sequence filter: one model, one set of sequences, the oracle beside them."""

import itertools
import math
import shutil
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import references
import torch
from small_agents import make_filter
from torch import Tensor

from torchrl_drbpn import GaussianTransition, LinearGaussianEmission
from torchrl_drbpn import functional as F
from torchrl_drbpn.functional import StateSpace, TransitionMLP, filter_sequence, native

SIZES = [
    pytest.param(3, 7, id="state<obs"),
    pytest.param(4, 4, id="state=obs"),
    pytest.param(6, 3, id="state>obs"),
]
built = pytest.mark.skipif(F.native_status() is not None, reason="not built")
compiles = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
FORMS = ["pytorch", pytest.param("native", marks=built), "step by step"]
TOLERANCE = 1e-10


def recording(graphs):
    """A backend of torch.compile that runs what was traced as it is, and keeps it in a list."""
    return lambda graph, _: graphs.append(graph) or graph


def assert_equal(actual, expected, tolerance=TOLERANCE, name="value", scale=1.0):
    limits = {"rtol": tolerance, "atol": tolerance * scale}
    torch.testing.assert_close(actual, expected, **limits, msg=lambda text: f"{name}: {text}")


class Inputs(NamedTuple):
    """What a filter takes."""

    mean: Tensor
    cov: Tensor | None
    previous_action: Tensor
    observation: Tensor
    observed: Tensor
    reset: Tensor


def sequences(state, batch=(3,), time=6, obs=5, action=2, seed=0):
    """Sequences with a reset inside one row, a frame of nothing and a frame of everything."""
    g, shape = torch.Generator().manual_seed(seed), (*batch, time)
    randn = partial(torch.randn, generator=g, dtype=torch.float64)
    observed = torch.rand(*shape, obs, generator=g) < 0.6
    observed[..., 1, :], observed[..., 2, :] = False, True
    observation = torch.where(observed, randn(*shape, obs), 0.0)
    reset = torch.zeros(*shape, dtype=torch.bool)
    reset[..., 0, 0] = reset[..., 1, 3] = True
    return Inputs(randn(*batch, state), None, randn(*shape, action), observation, observed, reset)


def outputs(*step):
    """Residual and innovation covariance, filtered mean and covariance, log-likelihood."""
    return (*F.innovation(*step), *F.update(*step), F.log_likelihood(*step))


def make_model(kind, dtype=torch.float64, obs=5, action=2, **options):
    state = {"information": 3, "free": 7, "network": 3}.get(kind, obs)
    place = {"cov": "full", "dtype": dtype}
    if kind == "full":
        with torch.random.fork_rng():
            torch.manual_seed(0)
            transition = GaussianTransition(state, action, activation="tanh", **place)
        emission = LinearGaussianEmission(obs, state, action, **place)
        options |= {"transition": transition, "emission": emission}
    if kind in ("propagated", "row"):
        options |= {"covariance": "propagated", "jacobian": "row" if kind == "row" else "mean"}
    return make_filter(obs, action, dtype, state, cov_network=kind == "network", **options)


def by_hand(
    model, mean, cov, action, observation, observed, reset, noise=None, jacobian=None, **stored
):
    """The oracle with a filter's own transition and emission."""
    emission = model.emission
    own = SimpleNamespace(
        transition=lambda m, a: model.transition(m, a)[0],
        transition_cov=lambda m, a: model.transition(m, a)[1],
        jacobian=jacobian,
        noise=emission.cov() if noise is None else noise,
        matrix=emission.matrix, action_matrix=emission.action_matrix, bias=emission.offset,
        initial_mean=model.initial_mean, initial_cov=model.initial_cov,
    )  # fmt: skip
    if model.covariance == "propagated" and jacobian is None:
        own.jacobian = model.mean_jacobian
    data = references.Data(observation, observed, action, reset, mean)
    return references.filter_sequence(own, data, start_cov=cov, **stored)


def space(system):
    """A linear system of the references as the library takes it."""
    return StateSpace(
        system.transition, system.transition_cov, system.matrix, system.noise, system.action_matrix,
        system.bias, system.initial_mean, system.initial_cov,
    )  # fmt: skip


class Problem:
    """A random model and data, as leaves to differentiate by, for the library and the oracle.

    Covariances enter through a factor (or variances), so that no gradient depends on which
    triangle of a symmetric matrix a formula happens to read.
    """

    weight: Tensor | None = None
    plain = ("matrix", "action_matrix", "bias", "initial_mean")

    def __init__(
        self,
        state,
        obs,
        *,
        batch=3,
        time=6,
        seed=0,
        full_noise=False,
        resets=True,
        stored=False,
        weighted=False,
        hidden=(5,),
        residual=True,
        activation="tanh",
        dtype=torch.float64,
        propagated=False,
    ):
        system = references.random_system(state, obs, seed=seed, full_noise=full_noise)
        data = references.simulate(
            system, batch, time, seed=seed, reset_rate=0.3 if resets else 0.0
        )
        g = torch.Generator().manual_seed(seed + 9)
        self.full_noise, self.residual, self.activation = full_noise, residual, activation
        self.observed, self.reset = data.observed, data.reset.clone()
        if resets and time > 2:
            # An episode start on an empty frame, on a full one, and none in the last row.
            self.reset[0, 0] = self.reset[0, 2] = True
            self.reset[-1] = False
        self.use_stored = None
        if weighted:  # small ones, ones, and zeros, which are missing entries
            weight = 4.0 * torch.rand(self.observed.shape, generator=g) - 1.5
            self.weight = weight.clamp(0, 1).to(dtype)
        leaves = {
            "observation": data.observation,
            "previous_action": data.previous_action,
            "start_mean": data.start_mean,
            "transition_root": torch.linalg.cholesky(system.transition_cov),
            "noise": torch.linalg.cholesky(system.noise) if full_noise else system.noise.diagonal(),
            **{name: getattr(system, name) for name in self.plain},
            "initial_root": torch.linalg.cholesky(system.initial_cov),
        }
        if stored:
            self.use_stored = torch.rand(batch, time, generator=g) < 0.4
            # With and without a reset beside it.
            self.use_stored[0, 2] = self.use_stored[-1, 1] = True
            leaves["stored_mean"] = torch.randn(batch, time, state, generator=g).double()
        self.jacobian = self.start_cov = self.stored_cov = None
        if propagated:
            # Constants of autograd; it expands in some directions.
            self.jacobian = 1.1 * system.dynamics.to(dtype)
            covs = [references.spd(state, g) for _ in range(batch * (1 + time))]
            covs = torch.stack(covs).to(dtype)
            self.start_cov = covs[:batch]
            self.stored_cov = covs[batch:].unflatten(0, (batch, time)) if stored else None
        widths = [state + system.action_dim, *hidden, state]
        for i, (fan_in, fan_out) in enumerate(itertools.pairwise(widths)):
            weight = torch.randn(fan_out, fan_in, generator=g).double()
            leaves[f"weight{i}"] = (0.5 if residual else 1.0) * weight / math.sqrt(fan_in)
            leaves[f"bias{i}"] = 0.1 * torch.randn(fan_out, generator=g).double()
        self.layers = len(widths) - 1
        self.leaves = {k: v.to(dtype).clone().requires_grad_() for k, v in leaves.items()}

    def network(self):
        return (
            tuple(self.leaves[f"weight{i}"] for i in range(self.layers)),
            tuple(self.leaves[f"bias{i}"] for i in range(self.layers)),
        )

    def covs(self):
        q, p = self.leaves["transition_root"], self.leaves["initial_root"]
        r = self.leaves["noise"]
        return q @ q.mT, p @ p.mT, r @ r.mT if self.full_noise else r

    def model(self, step_by_step=False):
        (q, p, r), leaf = self.covs(), self.leaves
        f = TransitionMLP(*self.network(), self.residual, self.activation)
        emission = leaf["matrix"], r, leaf["action_matrix"], leaf["bias"]
        by_step = lambda m, _: q.expand(*m.shape, -1)  # noqa: E731
        initial = leaf["initial_mean"], p
        return StateSpace(f, by_step if step_by_step else q, *emission, *initial, self.jacobian)

    def arguments(self):
        named = (self.leaves[k] for k in ("start_mean", "previous_action", "observation"))
        return (*named, self.observed, self.reset)

    def stored(self):
        names = {"stored_mean": self.leaves.get("stored_mean"), "stored_cov": self.stored_cov}
        return {"use_stored_state": self.use_stored, **names}

    def operator_arguments(self):
        mean, action, x, seen, reset = self.arguments()
        use, stored, stored_cov = self.stored().values()
        belief = (use, stored, mean, stored_cov, self.start_cov)
        return [x, seen, action, reset, *belief, *native.operator_arguments(self.model())]

    def run(self, form, *arguments, function=filter_sequence, **kwargs):
        """Filter by one form; "step by step" is what a Q that depends on the state takes."""
        by_step = form == "step by step"
        if self.jacobian is not None:
            kwargs = {"cov": self.start_cov, **kwargs}
        kwargs["form"] = "auto" if by_step else form
        return function(self.model(by_step), *(arguments or self.arguments()), **kwargs)

    def library(self, form):
        return self.run(form, **self.stored(), weight=self.weight, return_cov=True)

    def oracle(self):
        q, p, r = self.covs()
        noise, observed = r if self.full_noise else torch.diag(r), self.observed
        if self.weight is not None:
            added = noise.diagonal() * (1 / self.weight.clamp_min(1e-300) - 1)
            noise, observed = noise + torch.diag_embed(added), observed & (self.weight > 0)
        weights, biases = self.network()
        model = SimpleNamespace(
            transition=references.mean_network(weights, biases, self.residual, self.activation),
            transition_cov=q, noise=noise, initial_cov=p, jacobian=self.jacobian,
            **{name: self.leaves[name] for name in self.plain},
        )  # fmt: skip
        start, action, x, _, reset = self.arguments()
        data = references.Data(x, observed, action, reset, start)
        out = references.filter_sequence(model, data, start_cov=self.start_cov, **self.stored())
        return out.mean, out.cov, out.log_likelihood

    def gradients(self, outputs):
        """Differentiate one fixed random function of all the outputs by every leaf."""
        g = torch.Generator().manual_seed(3)
        loss = torch.zeros((), dtype=outputs[0].dtype)
        for out in outputs:
            weight = torch.randn(out.shape, generator=g, dtype=torch.float64).to(out.dtype)
            loss = loss + (weight * out).sum() + 0.1 * (weight * out.square()).sum()
        found = torch.autograd.grad(
            loss, list(self.leaves.values()), materialize_grads=True, retain_graph=True
        )
        return dict(zip(self.leaves, found, strict=True))


def assert_same(problem, actual, expected, tolerance=TOLERANCE):
    for name, a, e in zip(("mean", "cov", "log_likelihood"), actual, expected, strict=True):
        assert_equal(a, e, tolerance, name)
    found, truth = problem.gradients(actual), problem.gradients(expected)
    for name, e in truth.items():
        scale = max(1.0, float(e.abs().max()))
        assert_equal(found[name], e, tolerance, f"gradient by {name}", scale)
