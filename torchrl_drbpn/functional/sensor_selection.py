"""Choose sensors: the components whose readings leave the belief least uncertain."""

from numbers import Integral
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Criterion = Literal["D", "A"]

# Gains closer than this are a tie, nats for D, a share of tr C P C' for A: far above rounding.
_TIE = 1e-10


class SensorSelection(NamedTuple):
    r"""Hold sensors in the order in which they were chosen, and what each choice left.

    Args:
        indices: rows of H, best first, int64, shape ``(*batch, count)``.
        objective: of :math:`P^+` after the sensors up to this one: its log-determinant for "D"
            (nats), the trace of :math:`C P^+ C'` for "A" (squared units of the target); float64,
            shape ``(*batch, count)``.
        information: mutual information of the state and these readings,
            :math:`\tfrac12 (\log|P| - \log|P^+|)`, nats; float64, the same shape.
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
    target: Tensor | None = None,
) -> SensorSelection:
    r"""Choose the sensors that reduce the belief's uncertainty most, one after the other.

    .. math::
        \text{D:}\; \min_S \log|P^+_S| \;\Leftrightarrow\; \max_S I(s; x_S)
        = \tfrac12 \log|I + R_{SS}^{-1} H_S P H_S'|, \qquad
        \text{A:}\; \min_S \mathrm{tr}\, C P^+_S C'

    :math:`P^+_S` is the filtered covariance of eq. (10) [DRBPN] with the rows S observed, whatever
    they read. Greedy: the first k of a longer selection are the selection of k.

    - D, diagonal R: :math:`I(s; x_S)` is monotone and submodular, hence at least
      :math:`1 - 1/e` of the best set of that size [Nemhauser, Wolsey, Fisher 1978; Krause,
      Guestrin 2005; Shamaiah, Banerjee, Vikalo 2010].
    - D with a full R and A are monotone, not submodular: no such bound [Bian, Buhmann, Krause,
      Tschiatschek 2017; Chamon, Pappas, Ribeiro 2021].

    D does not depend on the units or the basis of the state, A does: for a learned state
    ``target=H`` adds up the variances of what the sensors would read without noise. Differences
    under 1e-10 (nats for D, of tr C P C' for A) are ties, which go to the lowest index. Computed in
    float64, without gradient.

    Args:
        emission_matrix: H, shape ``(*batch, obs, state)``.
        predicted_cov: P, the covariance before the readings, shape ``(*batch, state, state)``.
        emission_cov: R, shape ``(*batch, obs, obs)``, or its diagonal ``(obs,)``.
        count: how many to choose.
        criterion: "D", the log-determinant, or "A", the trace.
        target: C, the combinations of the state whose variances count for "A", shape
            ``(*batch, target, state)``; None: the whole state, C = I.

    Raises:
        ValueError: for matrices that do not fit, are not finite or no covariances, an unknown
            criterion, or more sensors than there are.

    Example:
        >>> H = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        >>> P, R = torch.diag(torch.tensor([4.0, 1.0])), torch.tensor([0.5, 0.4, 0.5])
        >>> select_sensors(H, P, R, 3).indices.tolist()  # the second view comes last
        [1, 2, 0]
    """
    if criterion not in ("D", "A"):
        raise ValueError(f"`criterion` must be 'D' (log det) or 'A' (trace), got {criterion!r}.")
    if target is not None and criterion != "A":
        raise ValueError("`target` weighs the trace: it needs criterion='A', got 'D'.")
    H, P, R = _as_matrices(emission_matrix, predicted_cov, emission_cov)
    obs, batch = H.shape[-2], H.shape[:-2]
    C = _as_target(target, H)
    whole = isinstance(count, Integral) and not isinstance(count, bool)
    if not whole or not 0 <= count <= obs:
        raise ValueError(f"`count` must be an int from 0 to {obs}, all sensors, got {count!r}.")
    # Given the readings so far: covariances of (x, C s) with x, and of the noise. Both matrices
    # lose a multiple of the same row with every reading, so the first two are one.
    joint, noise = torch.cat([H @ P @ H.mT + R, C @ P @ H.mT], -2), R
    initial_trace = trace = (C @ P * C).sum((-2, -1))
    information = torch.zeros_like(trace)
    seen = torch.zeros(*batch, obs, dtype=torch.bool, device=H.device)
    steps = []
    for _ in range(int(count)):
        # What was read has no variance left; 1 keeps the ratios defined. A reading varies at least
        # as its noise does, but for rounding.
        own = noise.diagonal(dim1=-2, dim2=-1).masked_fill(seen, 1.0)
        variance = joint[..., :obs, :].diagonal(dim1=-2, dim2=-1).masked_fill(seen, 1.0)
        variance = torch.maximum(variance, own)
        gained = 0.5 * (variance / own).log()  # I(s; x_i | readings)
        lowered = joint[..., obs:, :].square().sum(-2) / variance  # by how much tr C P+ C' falls
        gain = (gained if criterion == "D" else lowered).masked_fill(seen, -torch.inf)
        tie = _TIE if criterion == "D" else _TIE * initial_trace.unsqueeze(-1)
        # The first True: mathematically equal gains differ by rounding.
        best = gain >= gain.amax(-1, keepdim=True) - tie
        index = best.to(torch.uint8).argmax(-1, keepdim=True)
        information = information + gained.gather(-1, index).squeeze(-1)
        trace = trace - lowered.gather(-1, index).squeeze(-1)
        seen = seen.scatter(-1, index, True)
        joint, noise = _without(joint, index), _without(noise, index)
        steps.append((index.squeeze(-1), trace, information))
    if not steps:
        nothing = H.new_zeros(*batch, 0)
        return SensorSelection(nothing.long(), nothing, nothing)
    indices, traces, informations = (torch.stack(part, -1) for part in zip(*steps, strict=True))
    log_det = torch.linalg.slogdet(P).logabsdet.unsqueeze(-1)
    objective = log_det - 2.0 * informations if criterion == "D" else traces
    return SensorSelection(indices, objective, informations)


def _without(cov: Tensor, index: Tensor) -> Tensor:
    """Condition on one component: cov - cov[:, i] cov[i, :] / cov[i, i]."""
    rows, columns = cov.shape[-2:]
    row = cov.gather(-2, index.unsqueeze(-1).expand(*index.shape[:-1], 1, columns))
    column = cov.gather(-1, index.unsqueeze(-2).expand(*index.shape[:-1], rows, 1))
    pivot = row.gather(-1, index.unsqueeze(-1))
    return cov - column * (row / pivot)


def _as_matrices(H: Tensor, P: Tensor, R: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return H, P and R as matrices in float64 with one batch shape; refuse what is none."""
    if H.ndim < 2 or 0 in H.shape[-2:] or not bool(H.isfinite().all()):
        raise ValueError(
            f"`emission_matrix` must be H, finite, of shape (*batch, obs, state), got "
            f"{tuple(H.shape)}. Was it learned, and did it diverge?"
        )
    R = R.diag() if R.ndim == 1 else R
    for name, cov, size in (("predicted_cov", P, H.shape[-1]), ("emission_cov", R, H.shape[-2])):
        if cov.shape[-2:] != (size, size):
            raise ValueError(
                f"`{name}` must be of shape (*batch, {size}, {size}) as `emission_matrix` "
                f"{tuple(H.shape)} has it, got {tuple(cov.shape)}."
            )
        # A product such as J P J' in float32 is symmetric up to rounding only.
        scale = cov.diagonal(dim1=-2, dim2=-1).abs().amax()
        symmetric = bool((cov - cov.mT).abs().amax() <= 1e-5 * scale)
        if not symmetric or bool(torch.linalg.cholesky_ex(cov.double()).info.any()):
            raise ValueError(
                f"`{name}` must be finite, symmetric and positive definite: a direction without "
                "any variance has no log-determinant. Add a small variance to its diagonal."
            )
    shapes = [x.shape[:-2] for x in (H, P, R)]
    try:
        batch = (H[..., 0, 0] + P[..., 0, 0] + R[..., 0, 0]).shape
    except RuntimeError as error:
        raise ValueError(
            "`emission_matrix`, `predicted_cov` and `emission_cov` must have batch shapes that "
            f"broadcast, got {', '.join(str(tuple(shape)) for shape in shapes)}."
        ) from error
    H, P, R = (x.double().expand(*batch, *x.shape[-2:]) for x in (H, P, R))
    return H, 0.5 * (P + P.mT), 0.5 * (R + R.mT)


def _as_target(C: Tensor | None, H: Tensor) -> Tensor:
    """Return C in float64 and in H's batch shape; the identity where there is none."""
    state, batch = H.shape[-1], H.shape[:-2]
    C = torch.eye(state, dtype=H.dtype, device=H.device) if C is None else C.double()
    own = C.shape[:-2]
    fits = len(own) <= len(batch) and all(
        n in (1, of_model) for n, of_model in zip(own[::-1], batch[::-1], strict=False)
    )
    if C.ndim < 2 or C.shape[-1] != state or not fits or not bool(C.isfinite().all()):
        raise ValueError(
            f"`target` must be finite and of shape (*batch, target, state) with state={state} and "
            f"the batch shape {tuple(batch)} of the model or none, got {tuple(C.shape)}."
        )
    return C.expand(*batch, *C.shape[-2:])
