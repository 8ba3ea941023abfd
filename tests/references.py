"""Slow float64 truths that the library is held to.

Everything here is written from the definitions and shares no code with the package. The row of a
missing entry is deleted before any arithmetic. Batch and time are Python loops, linear systems go
through `torch.linalg.solve` (LU, where the library uses Cholesky).

Symbols: m, P are the mean and covariance of a belief, H, R, B, d the emission of eq. (3)
x = H s + B a + d + noise, Q the transition covariance, rows the indices of the observed entries.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

Transition = Callable[[Tensor, Tensor], Tensor]


def predict(mean, cov, transition, transition_cov, action, jacobian=None):
    """Eq. (8): m = f(m, a), P = Q; or P = J P J' + Q where a Jacobian is given."""
    if jacobian is None:
        return transition(mean, action), transition_cov
    return transition(mean, action), jacobian @ cov @ jacobian.T + transition_cov


def observed_rows(observation, observed, matrix, noise, offset=None):
    """What arrived less its offset, and the rows of H and R that belong to it."""
    rows = observed.nonzero().squeeze(-1)
    x = observation[rows]
    if offset is not None:
        x = x - offset[rows]
    return x, matrix[rows], noise[rows][:, rows]


def update(mean, cov, *step):
    """Eq. (10) on the observed rows alone; `step` is what `observed_rows` takes."""
    x, h, r = observed_rows(*step)
    if x.numel() == 0:
        return mean, cov
    s = h @ cov @ h.T + r
    gain = torch.linalg.solve(s, h @ cov.T).T
    return mean + gain @ (x - h @ mean), cov - gain @ h @ cov


def log_likelihood(mean, cov, *step):
    """Eq. (12): the log density of the observed entries under the predicted belief."""
    x, h, r = observed_rows(*step)
    if x.numel() == 0:
        return mean.new_zeros(())
    residual = x - h @ mean
    s = h @ cov @ h.T + r
    mahalanobis = residual @ torch.linalg.solve(s, residual)
    return -0.5 * (mahalanobis + torch.logdet(s) + x.numel() * math.log(2 * math.pi))


@dataclass(frozen=True)
class Sequence:
    """Filtered means (b, t, s), filtered covariances (b, t, s, s), log-likelihoods (b, t)."""

    mean: Tensor
    cov: Tensor
    log_likelihood: Tensor


def filter_sequence(
    model, data, *, start_cov=None, use_stored_state=None, stored_mean=None, stored_cov=None
):
    """Filter [batch, time] data one row and one step at a time; `model` has the fields of a system.

    `data.start_mean` (b, s) is the filtered belief of the step before the first one. At a step with
    `reset` (b, t) the predicted belief is the initial one. At a step with
    `use_stored_state` (b, t) the belief before the step is not the one just computed but
    `stored_mean` (b, t, s).
    Where both hold, the reset wins. `transition_cov` is a matrix or a function of (mean, action),
    so is `jacobian`: with it the covariance is propagated, from `start_cov` (b, s, s) and
    `stored_cov` (b, t, s, s); what is propagated is a constant of autograd.
    `noise` is R (n, n), or of every step one of its own (b, t, n, n), or a function of the
    predicted mean and covariance, the observation, its mask and the offset.
    """
    batch, time = data.observed.shape[:2]
    m, out = model, []
    for b in range(batch):
        mean = data.start_mean[b]
        cov = m.initial_cov if start_cov is None else start_cov[b]
        for t in range(time):
            action = data.previous_action[b, t]
            if use_stored_state is not None and stored_mean is not None and use_stored_state[b, t]:
                mean = stored_mean[b, t]
                cov = cov if stored_cov is None else stored_cov[b, t]
            if data.reset[b, t]:
                mean, cov = m.initial_mean, m.initial_cov
            else:
                q = m.transition_cov
                q = q(mean, action) if callable(q) else q
                f = m.jacobian(mean, action).detach() if callable(m.jacobian) else m.jacobian
                mean, cov = predict(mean, cov.detach(), m.transition, q, action, f)
            offset = m.action_matrix @ action + m.bias
            x, seen = data.observation[b, t], data.observed[b, t]
            if callable(m.noise):
                own = m.noise(mean, cov, x, seen, offset)
            else:
                own = m.noise[b, t] if m.noise.ndim == 4 else m.noise
            step = (x, seen, m.matrix, own, offset)
            ll = log_likelihood(mean, cov, *step)
            mean, cov = update(mean, cov, *step)
            out.append((mean, cov, ll))
    return Sequence(*(torch.stack(x).unflatten(0, (batch, time)) for x in zip(*out, strict=True)))


def mean_network(weights, biases, residual, activation):
    """Eq. (8) as a plain function: layers of W z + b with relu or tanh between them."""

    def transition(mean, action):
        z = torch.cat([mean, action], -1)
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            if i > 0:
                z = {"relu": torch.relu, "tanh": torch.tanh}[activation](z)
            z = (weight @ z.unsqueeze(-1)).squeeze(-1) + bias
        return mean + z if residual else z

    return transition


@dataclass(frozen=True)
class LinearSystem:
    """s' = A s + C a + q, q ~ N(0, Q);  x = H s + B a + d + e, e ~ N(0, R)."""

    dynamics: Tensor  # A, shape: (s, s)
    control: Tensor  # C, shape: (s, a)
    transition_cov: Tensor  # Q, shape: (s, s)
    matrix: Tensor  # H, shape: (n, s)
    action_matrix: Tensor  # B, shape: (n, a)
    bias: Tensor  # d, shape: (n,)
    noise: Tensor  # R, shape: (n, n)
    initial_mean: Tensor  # shape: (s,)
    initial_cov: Tensor  # shape: (s, s)

    @property
    def state_dim(self):
        return self.matrix.shape[1]

    @property
    def obs_dim(self):
        return self.matrix.shape[0]

    @property
    def action_dim(self):
        return self.control.shape[1]

    def transition(self, mean, action):
        return mean @ self.dynamics.T + action @ self.control.T

    def offset(self, action):
        return action @ self.action_matrix.T + self.bias

    def to(self, dtype):
        return replace(self, **{k: v.to(dtype) for k, v in vars(self).items()})


def spd(dim, generator, scale=1.0):
    """A well-conditioned random covariance of standard deviation about `scale`."""
    a = torch.randn(dim, dim, generator=generator, dtype=torch.float64)
    cov = scale**2 * (a @ a.T / dim + 0.3 * torch.eye(dim, dtype=torch.float64))
    return (cov + cov.T) / 2


def random_system(state, obs, action=2, *, seed=0, full_noise=False):
    """A random stable system with an initial covariance that has nothing to do with Q."""
    g = torch.Generator().manual_seed(seed)
    randn = partial(torch.randn, generator=g, dtype=torch.float64)
    diagonal = (0.2 + 0.5 * torch.rand(obs, generator=g, dtype=torch.float64)) ** 2
    return LinearSystem(
        dynamics=0.9 * torch.linalg.qr(randn(state, state))[0],
        control=0.3 * randn(state, action),
        transition_cov=spd(state, g, 0.5),
        matrix=randn(obs, state) / math.sqrt(state),
        action_matrix=0.3 * randn(obs, action),
        bias=0.3 * randn(obs),
        noise=spd(obs, g, 0.4) if full_noise else torch.diag(diagonal),
        initial_mean=randn(state),
        initial_cov=spd(state, g, 1.5),
    )


@dataclass(frozen=True)
class Data:
    """What a filter is given: (b, t, n) observations with 0 where missing, and the rest."""

    observation: Tensor
    observed: Tensor
    previous_action: Tensor
    reset: Tensor
    start_mean: Tensor


def simulate(system, batch, time, *, seed=0, missing_rate=0.4, reset_rate=0.0):
    """Draw data from the system with independent dropouts and, if asked, resets inside rows.

    Where it fits, one frame holds nothing, one holds a single entry and one holds everything.
    """
    g = torch.Generator().manual_seed(1000 + seed)
    randn = partial(torch.randn, generator=g, dtype=torch.float64)
    n, s = system.obs_dim, system.state_dim
    root_q = torch.linalg.cholesky(system.transition_cov)
    root_r = torch.linalg.cholesky(system.noise)
    root_p = torch.linalg.cholesky(system.initial_cov)
    start_mean = randn(batch, s)
    action = randn(batch, time, system.action_dim)
    reset = torch.rand(batch, time, generator=g) < reset_rate
    observed = torch.rand(batch, time, n, generator=g) >= missing_rate
    if time >= 3:
        observed[0, 0] = False
        observed[0, 1] = False
        observed[0, 1, n // 2] = True
        observed[0, 2] = True
    action = torch.where(reset.unsqueeze(-1), torch.zeros_like(action), action)
    state, frames = start_mean, []
    for t in range(time):
        fresh = system.initial_mean + randn(batch, s) @ root_p.T
        moved = system.transition(state, action[:, t]) + randn(batch, s) @ root_q.T
        state = torch.where(reset[:, t, None], fresh, moved)
        frames.append(
            state @ system.matrix.T + system.offset(action[:, t]) + randn(batch, n) @ root_r.T
        )
    observation = torch.stack(frames, 1)
    observation = torch.where(observed, observation, torch.zeros_like(observation))
    return Data(observation, observed, action, reset, start_mean)


def joint_gaussian(system, data, row):
    """Mean m and covariance P of all states of a row, and H, R, x of all that arrived.

    The states are one Gaussian vector and x = H m + noise, missing entries deleted. No filter is
    involved. The row starts from the initial belief; an episode start cuts what lies before.
    """
    time, s = data.reset.shape[1], system.state_dim
    means, blocks = [], {}
    eye = torch.eye(s, dtype=torch.float64)
    for t in range(time):
        if t == 0 or data.reset[row, t]:
            mean, F, Q = system.initial_mean, 0 * eye, system.initial_cov
        else:
            mean = system.transition(means[-1], data.previous_action[row, t])
            F, Q = system.dynamics, system.transition_cov
        means.append(mean)
        for j in range(t):
            blocks[t, j] = F @ blocks[t - 1, j]
            blocks[j, t] = blocks[t, j].mT
        blocks[t, t] = (F @ blocks[t - 1, t - 1] @ F.mT if t else 0) + Q
    steps = range(time)
    prior = torch.cat([torch.cat([blocks[i, j] for j in steps], 1) for i in steps])
    seen = data.observed[row].flatten()
    H = torch.block_diag(*[system.matrix] * time)[seen]
    R = torch.block_diag(*[system.noise] * time)[seen][:, seen]
    offset = system.offset(data.previous_action[row]).flatten()[seen]
    return torch.cat(means), prior, H, R, data.observation[row].flatten()[seen] - offset


def statsmodels(system, data):
    """Bind the first row to statsmodels' filter and smoother."""
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    x, observed, action = data.observation[0], data.observed[0], data.previous_action[0]
    theirs = KalmanSmoother(k_endog=system.obs_dim, k_states=system.state_dim)
    theirs.bind(torch.where(observed, x, torch.nan).numpy())
    moves = action[1:] @ system.control.T  # theirs lead from a step to the next
    last = torch.zeros(1, system.state_dim, dtype=torch.float64)
    for name, value in (
        ("design", system.matrix), ("obs_cov", system.noise), ("transition", system.dynamics),
        ("obs_intercept", system.offset(action).T), ("selection", torch.eye(system.state_dim)),
        ("state_intercept", torch.cat([moves, last]).T), ("state_cov", system.transition_cov),
    ):  # fmt: skip
        theirs[name] = value.numpy()
    theirs.initialize_known(system.initial_mean.numpy(), system.initial_cov.numpy())
    return theirs
