r"""Choose sensors: the components whose readings leave the belief least uncertain.

With x = H s + eps, s ~ N(m, P) and eps ~ N(0, R), reading the rows S leaves the covariance
:math:`P^+_S`, whatever the readings are (eq. 10 [DRBPN]). So which sensors are worth having is
known from H, P and R alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Literal, NamedTuple

import torch
from torch import Tensor

__all__ = ["SensorSelection", "select_sensors"]

Criterion = Literal["D", "A"]

# Gains closer than this are a tie, nats for D, a share of tr C P C' for A: far above rounding.
_TIE = 1e-10


class SensorSelection(NamedTuple):
    r"""Hold sensors in the order in which they were chosen, and what each choice left.

    Args:
        indices: rows of H, best first, int64, shape ``(*batch, count)``.
        objective: of the covariance :math:`P^+` filtered with ``always`` and the sensors up to
            this one: its log-determinant for "D" (nats), the trace of :math:`C P^+ C'` for "A"
            (squared units of the target); float64, shape ``(*batch, count)``.
        information: what these readings say about the state beyond ``always``,
            :math:`\tfrac12 (\log|P^+_{always}| - \log|P^+|)`, nats, whichever the criterion;
            float64, shape ``(*batch, count)``.

    Example:
        >>> import torch
        >>> eye = torch.eye(3)
        >>> chosen = select_sensors(eye, eye, torch.tensor([1.0, 0.1, 0.5]), 2)
        >>> chosen.indices.tolist(), bool((chosen.information.diff() > 0).all())
        ([1, 2], True)
    """

    indices: Tensor
    objective: Tensor
    information: Tensor


@torch.no_grad()
def select_sensors(
    emission_matrix: Tensor,
    predicted_cov: Tensor,
    emission_cov: Tensor,
    count: int,
    *,
    criterion: Criterion = "D",
    always: Sequence[int] | Sequence[bool] | Tensor = (),
    target: Tensor | None = None,
) -> SensorSelection:
    r"""Choose the sensors that reduce the belief's uncertainty most, one after the other.

    .. math::
        \text{D:}\; \min_S \log|P^+_S| \;\Leftrightarrow\; \max_S I(s; x_S)
        = \tfrac12 \log|I + R_{SS}^{-1} H_S P H_S'|, \qquad
        \text{A:}\; \min_S \mathrm{tr}\, C P^+_S C'

    :math:`P^+_S` is the filtered covariance of eq. (10) [DRBPN] with the rows S observed. Greedy:
    each pick is the best one beside those before it, so the first k of a longer selection are the
    selection of k. Every pick evaluates all candidates at once and costs one rank-one update,
    O(obs (obs + state)).

    How good greedy is:

    - D, diagonal R: :math:`I(s; x_S)` is monotone and submodular, hence at least
      :math:`1 - 1/e` of the best set of that size [Nemhauser, Wolsey, Fisher 1978; Krause,
      Guestrin 2005; Shamaiah, Banerjee, Vikalo 2010]. With ``always`` this holds for what is
      gained beyond it.
    - D, full R: still monotone, but not submodular: a sensor that reads nothing but another
      one's noise is worthless alone and priceless beside it. No such bound.
    - A: monotone, but not submodular. Weaker bounds depend on how far from it the problem is
      [Bian, Buhmann, Krause, Tschiatschek 2017; Chamon, Pappas, Ribeiro 2021].

    D does not depend on the units or the basis of the state (s -> T s with T invertible), A does:
    for a learned state, whose units mean nothing, ``target=H`` adds up the variances of what the
    sensors would read without noise. Differences under 1e-10 (nats for D, of tr C P C' for A)
    count as ties, which go to the lowest index. Computed in float64; no gradient.

    Args:
        emission_matrix: H, shape ``(*batch, obs, state)``.
        predicted_cov: P, the covariance before the readings, shape ``(*batch, state, state)``,
            symmetric positive definite.
        emission_cov: R, shape ``(*batch, obs, obs)``, or ``(obs,)`` for the variances of a
            diagonal R, as :class:`StateSpace` holds it.
        count: how many to choose.

    Keyword Args:
        criterion: "D", the log-determinant, or "A", the trace.
        always: sensors that are there anyway: indices, or bool of shape ``(obs,)``; the same for
            the whole batch. They are read first and not chosen.
        target: C, what of the state is to be known, shape ``(*batch, target, state)``; "A" only.
            None: the whole state, C = I.

    Returns:
        The :class:`SensorSelection`.

    Raises:
        ValueError: for shapes that do not fit, covariances that are none, values that are not
            finite, an unknown criterion, sensors that do not exist, or more than there are.

    Example:
        >>> import torch
        >>> H = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        >>> P, R = torch.diag(torch.tensor([4.0, 1.0])), torch.tensor([0.5, 0.4, 0.5])
        >>> chosen = select_sensors(H, P, R, 3)
        >>> chosen.indices.tolist()  # the second view of the first state comes last
        [1, 2, 0]
        >>> gain = chosen.information[0]
        >>> torch.allclose(gain, 0.5 * torch.tensor(1 + 4 / 0.4).double().log())
        True

    For a trained :class:`~torchrl_drbpn.BeliefFilter` with a constant Q, P = Q::

        model = belief_filter.state_space()
        select_sensors(model.emission_matrix, model.transition_cov, model.emission_cov, 4)

    See also :func:`update`, whose covariance this is.
    """
    if criterion not in ("D", "A"):
        raise ValueError(f"`criterion` must be 'D' (log det) or 'A' (trace), got {criterion!r}.")
    if target is not None and criterion != "A":
        raise ValueError("`target` weighs the trace: it needs criterion='A', got 'D'.")
    H, P, R = _checked_model(emission_matrix, predicted_cov, emission_cov)
    C = _checked_target(target, H)
    obs = H.shape[-2]
    there = _checked_always(always, obs)
    candidates = obs - len(there)
    if isinstance(count, bool) or not isinstance(count, Integral) or not 0 <= count <= candidates:
        raise ValueError(
            f"`count` must be an int from 0 to {candidates}, the sensors that are not in `always`, "
            f"got {count!r}."
        )
    readings = _Readings(H, P, R, C)
    for sensor in there:
        readings.read(torch.full(H.shape[:-2], sensor, device=H.device))
    initial_log_det = torch.linalg.slogdet(P).logabsdet
    already = readings.information
    indices, objective, information = [], [], []
    for _ in range(int(count)):
        gain = readings.information_gain() if criterion == "D" else readings.trace_gain()
        tie = _TIE if criterion == "D" else _TIE * readings.initial_trace.unsqueeze(-1)
        gain = gain.masked_fill(readings.seen, -torch.inf)
        # The first True: mathematically equal gains differ by rounding.
        best = (gain >= gain.amax(-1, keepdim=True) - tie).to(torch.uint8).argmax(-1)
        readings.read(best)
        indices.append(best)
        information.append(readings.information - already)
        objective.append(
            initial_log_det - 2.0 * readings.information if criterion == "D" else readings.trace
        )
    if not count:
        nothing = H.new_zeros(*H.shape[:-2], 0)
        return SensorSelection(nothing.long(), nothing, nothing)
    return SensorSelection(*(torch.stack(x, -1) for x in (indices, objective, information)))


class _Readings:
    r"""Condition the joint Gaussian of readings, state and noise on one reading after the other.

    Kept, given the readings so far: V = Cov(x, x), G = Cov(C s, x), N = Cov(eps, eps | eps so far).
    Conditioning on reading i takes a rank-one term from each: V -= V_i V_i' / V_ii, and so on.
    """

    def __init__(self, H: Tensor, P: Tensor, R: Tensor, C: Tensor) -> None:
        G = P @ H.mT
        # Both in one matrix, since both lose a multiple of the same row.
        self.joint = torch.cat([H @ G + R, C @ G], -2)  # (*batch, obs + target, obs)
        self.noise = R.clone()
        self.obs = H.shape[-2]
        self.batch = H.shape[:-2]
        self.trace = self.initial_trace = (C @ P * C).sum((-2, -1))
        self.information = torch.zeros_like(self.trace)
        self.seen = torch.zeros(*self.batch, self.obs, dtype=torch.bool, device=H.device)

    def _variances(self) -> tuple[Tensor, Tensor]:
        """Return the variance of each reading and of its noise, given the readings so far."""
        noise = self.noise.diagonal(dim1=-2, dim2=-1)
        reading = self.joint[..., : self.obs, :].diagonal(dim1=-2, dim2=-1)
        # What was read has no variance left; 1 keeps the ratios defined. A reading varies at least
        # as its noise does, but for rounding.
        noise = noise.masked_fill(self.seen, 1.0)
        return torch.maximum(reading.masked_fill(self.seen, 1.0), noise), noise

    def information_gain(self) -> Tensor:
        r"""I(s; x_i | readings) = 1/2 log (Var(x_i | readings) / Var(eps_i | noise so far))."""
        reading, noise = self._variances()
        return 0.5 * (reading / noise).log()

    def trace_gain(self) -> Tensor:
        r"""By how much reading i lowers tr C P+ C': |Cov(C s, x_i)|^2 / Var(x_i)."""
        reading, _ = self._variances()
        return self.joint[..., self.obs :, :].square().sum(-2) / reading

    def read(self, sensor: Tensor) -> None:
        """Take in the reading of one sensor. sensor: (*batch,)."""
        index = sensor.unsqueeze(-1)
        self.information = self.information + self.information_gain().gather(-1, index).squeeze(-1)
        self.trace = self.trace - self.trace_gain().gather(-1, index).squeeze(-1)
        self.seen = self.seen.scatter(-1, index, True)
        self.joint = _without(self.joint, index)
        self.noise = _without(self.noise, index)


def _without(cov: Tensor, index: Tensor) -> Tensor:
    """Condition on one component: cov - cov[:, i] cov[i, :] / cov[i, i]."""
    rows, columns = cov.shape[-2:]
    row = cov.gather(-2, index.unsqueeze(-1).expand(*index.shape[:-1], 1, columns))
    column = cov.gather(-1, index.unsqueeze(-2).expand(*index.shape[:-1], rows, 1))
    pivot = row.gather(-1, index.unsqueeze(-1))
    return cov - column * (row / pivot)


# Arguments --------------------------------------------------------------------------------------


def _checked_model(H: Tensor, P: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return H, P and R as matrices in float64 with one batch shape, or say what is wrong."""
    if H.ndim < 2 or 0 in H.shape[-2:]:
        raise ValueError(
            f"`emission_matrix` must be H of shape (*batch, obs, state), got {tuple(H.shape)}."
        )
    obs, state = H.shape[-2:]
    if P.shape[-2:] != (state, state):
        raise ValueError(
            f"`predicted_cov` must be of shape (*batch, state, state) with state={state} as "
            f"`emission_matrix` has it, got {tuple(P.shape)}."
        )
    if R.shape != (obs,) and R.shape[-2:] != (obs, obs):
        raise ValueError(
            f"`emission_cov` must be of shape (*batch, obs, obs), or (obs,) for variances, with "
            f"obs={obs} as `emission_matrix` has it, got {tuple(R.shape)}. A batch of variances "
            "is given as matrices: torch.diag_embed."
        )
    H, P, R = H.double(), P.double(), R.double()
    P, R = _checked_cov("predicted_cov", P), _checked_cov("emission_cov", R)
    if not bool(H.isfinite().all()):
        raise ValueError("`emission_matrix` holds NaN or inf: was it learned, and did it diverge?")
    try:
        batch = (H[..., 0, 0] + P[..., 0, 0] + R[..., 0, 0]).shape
    except RuntimeError as error:
        raise ValueError(
            "`emission_matrix`, `predicted_cov` and `emission_cov` must have batch shapes that "
            f"broadcast, got {tuple(H.shape[:-2])}, {tuple(P.shape[:-2])}, {tuple(R.shape[:-2])}."
        ) from error
    return H.expand(*batch, obs, state), P.expand(*batch, state, state), R.expand(*batch, obs, obs)


def _checked_cov(name: str, cov: Tensor) -> Tensor:
    """Return a covariance as a symmetric matrix, or say that it is none."""
    if cov.ndim == 1:
        if not bool((cov > 0).all() & cov.isfinite().all()):
            raise ValueError(f"`{name}` must hold variances above 0, got {cov.tolist()}.")
        return cov.diag()
    scale = cov.diagonal(dim1=-2, dim2=-1).abs().amax()
    # A product such as J P J' in float32 is symmetric up to rounding only.
    if not bool((cov - cov.mT).abs().amax() <= 1e-5 * scale):
        raise ValueError(f"`{name}` must be symmetric and finite.")
    cov = 0.5 * (cov + cov.mT)
    if bool(torch.linalg.cholesky_ex(cov).info.any()):
        raise ValueError(
            f"`{name}` must be positive definite: a direction without any variance has no "
            "log-determinant. Add a small variance to its diagonal."
        )
    return cov


def _checked_target(C: Tensor | None, H: Tensor) -> Tensor:
    """Return C in float64 and in H's batch shape; the identity where there is none."""
    state = H.shape[-1]
    if C is None:
        return torch.eye(state, dtype=H.dtype, device=H.device).expand(*H.shape[:-2], state, state)
    if C.ndim < 2 or C.shape[-1] != state or not bool(C.isfinite().all()):
        raise ValueError(
            f"`target` must be finite and of shape (*batch, target, state) with state={state} as "
            f"`emission_matrix` has it, got {tuple(C.shape)}."
        )
    try:
        return C.double().expand(*H.shape[:-2], *C.shape[-2:])
    except RuntimeError as error:
        raise ValueError(
            f"`target` must have the batch shape {tuple(H.shape[:-2])} of the model or none, got "
            f"{tuple(C.shape[:-2])}."
        ) from error


def _checked_always(always: Sequence[int] | Sequence[bool] | Tensor, obs: int) -> list[int]:
    """Return the indices of the sensors that are there anyway, each once, in order."""
    tensor = torch.as_tensor(always)
    if tensor.numel() == 0 and tensor.dtype != torch.bool:
        return []
    if tensor.ndim != 1 or tensor.is_floating_point() or tensor.is_complex():
        raise ValueError(
            "`always` must be a list of indices or a bool vector, True where a sensor is there "
            f"anyway, got {always!r}."
        )
    if tensor.dtype == torch.bool:
        if tensor.shape[0] != obs:
            raise ValueError(
                f"`always` as bool must have one entry per sensor, {obs}, got {tensor.shape[0]}."
            )
        return [int(i) for i in tensor.nonzero().flatten()]
    if bool(((tensor < -obs) | (tensor >= obs)).any()):
        raise ValueError(
            f"`always` must hold indices from {-obs} to {obs - 1}, got {tensor.tolist()}."
        )
    return sorted({int(i) % obs for i in tensor})
