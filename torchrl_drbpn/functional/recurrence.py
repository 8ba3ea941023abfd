"""The sequential core of the fast filter: mean recurrences with hand-written reverse loops.

With a constant transition covariance everything but the mean depends on the masks and on the
episode starts alone, so it is computed for a whole ``[time, batch]`` minibatch ahead of the loop
(design: one small network and two matrix-vector products a step remain). The reverse loop is
written by hand for two reasons: weight gradients become single matrix products after the loop,
and no gradient of a batched Cholesky factorisation is ever taken.

All tensors here are time-major, ``[time, batch, ...]``. The public door is
:func:`torchrl_drbpn.functional.filtering.filter_sequence`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchrl_drbpn.functional.compiled import spd_inverse
from torchrl_drbpn.functional.gaussian import LOG_2PI
from torchrl_drbpn.functional.precision import outside_autocast

__all__ = ["ACTIVATIONS", "InformationRecurrence", "InnovationRecurrence", "MeanNetwork"]

ACTIVATIONS = ("relu", "tanh")

_relu_backward = torch.ops.aten.threshold_backward.default
_tanh_backward = torch.ops.aten.tanh_backward.default


class MeanNetwork(NamedTuple):
    r"""Describe the transition mean f(mean, action) as plain tensors.

    .. math:: f(m, a) = [m +] \; W_k \, \sigma(\dots \sigma(W_1 (m, a) + b_1)) + b_k

    Eq. (8) [DRBPN]. Knowing the weights is what lets the fast filter write its own reverse loop.

    Args:
        weights: of each layer, shape ``(out, in)``; the first layer's ``in`` is state + action,
            in this order.
        biases: of each layer, shape ``(out,)``.
        residual: whether the mean is added to the output.
        activation: "relu" or "tanh", between the layers.

    Example:
        >>> import torch
        >>> weights, biases = (torch.zeros(3, 5),), (torch.zeros(3),)
        >>> f = MeanNetwork(weights, biases, residual=True, activation="relu")
        >>> f(torch.ones(4, 3), torch.zeros(4, 2)).tolist() == torch.ones(4, 3).tolist()
        True
    """

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    residual: bool
    activation: str

    def __call__(self, mean: Tensor, action: Tensor) -> Tensor:
        """Evaluate f.

        Args:
            mean: shape ``(*batch, state)``.
            action: shape ``(*batch, action)``.

        Returns:
            Shape ``(*batch, state)``.
        """
        hidden = torch.cat([mean, action], -1)
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.nn.functional.linear(hidden, weight, bias)
            if i < last:
                hidden = hidden.relu() if self.activation == "relu" else hidden.tanh()
        return mean + hidden if self.residual else hidden


class _Steps:
    """The network of one step, forward and back, over [batch, ...] tensors.

    The first layer's action part is computed for the whole sequence outside (``drive``), so a
    step sees only the mean's part ``first``.
    """

    def __init__(
        self, residual: bool, activation: str, first: Tensor, rest: tuple[Tensor, ...]
    ) -> None:
        self.residual = residual
        self.relu = activation == "relu"
        self.first = first
        self.weights = rest[0::2]
        self.biases = rest[1::2]
        self.first_t = first.t()
        self.weights_t = [w.t() for w in self.weights]

    def forward(self, previous: Tensor, drive: Tensor) -> tuple[Tensor, list[Tensor]]:
        x = torch.addmm(drive, previous, self.first_t)
        hidden: list[Tensor] = []
        for weight_t, bias in zip(self.weights_t, self.biases, strict=True):
            x = x.relu_() if self.relu else x.tanh_()
            hidden.append(x)
            x = torch.addmm(bias, x, weight_t)
        return (x.add_(previous) if self.residual else x), hidden

    def backward(self, grad: Tensor, hidden: tuple[Tensor, ...]) -> tuple[Tensor, list[Tensor]]:
        """Return the gradient by ``previous`` and by every pre-activation, first layer first."""
        x = grad
        grads: list[Tensor] = []
        for weight, h in zip(reversed(self.weights), reversed(hidden), strict=True):
            grads.append(x)
            x = x @ weight
            # relu' and tanh' from the stored output, each in one operation.
            x = _relu_backward(x, h, 0) if self.relu else _tanh_backward(x, h)
        grads.append(x)
        back = torch.addmm(grad, x, self.first) if self.residual else x @ self.first
        return back, grads[::-1]

    def weight_grads(
        self, previous: Tensor, hidden: list[Tensor], grads: list[Tensor]
    ) -> list[Tensor]:
        """Turn stacked [time * batch, ...] gradients into those of first, W2, b2, W3, b3, ..."""
        out = [grads[0].t() @ previous]
        for h, g in zip(hidden, grads[1:], strict=True):
            out += [g.t() @ h, g.sum(0)]
        return out


def _run(
    steps: _Steps,
    drive: Tensor,
    start: Tensor,
    reset: Tensor,
    initial_mean: Tensor,
    restart: Tensor | None,
    restart_mean: Tensor | None,
    gain: Tensor,
    target: Tensor,
    emission: Tensor | None,
) -> tuple[list[Tensor], list[Tensor], list[Tensor], list[list[Tensor]]]:
    """Run the mean recurrence; returns predicted and filtered means, inputs of f, hidden layers.

    With ``emission`` H: mean = m + (y - m H') gain, gain [time, batch, obs, state].
    Without:             mean = m + target - gain m, gain [time, batch, state, state].
    """
    predicted_all: list[Tensor] = []
    filtered_all: list[Tensor] = []
    inputs: list[Tensor] = []
    hidden_all: list[list[Tensor]] = []
    emission_t = None if emission is None else emission.t()
    restarts = (None,) * len(drive) if restart is None else restart.unbind(0)
    stored = restarts if restart_mean is None else restart_mean.unbind(0)
    mean = start
    for drive_t, reset_t, gain_t, target_t, restart_t, stored_t in zip(
        drive.unbind(0),
        reset.unbind(0),
        gain.unbind(0),
        target.unbind(0),
        restarts,
        stored,
        strict=True,
    ):
        if restart_t is not None and stored_t is not None:
            mean = torch.where(restart_t, stored_t, mean)
        inputs.append(mean)
        mean, hidden = steps.forward(mean, drive_t)
        hidden_all.append(hidden)
        mean = torch.where(reset_t, initial_mean, mean)
        predicted_all.append(mean)
        if emission_t is not None:
            error = torch.addmm(target_t, mean, emission_t, alpha=-1).unsqueeze(1)
            mean = torch.baddbmm(mean.unsqueeze(1), error, gain_t).squeeze(1)
        else:
            pulled = torch.baddbmm(target_t.unsqueeze(2), gain_t, mean.unsqueeze(2), alpha=-1)
            mean = mean + pulled.squeeze(2)
        filtered_all.append(mean)
    return predicted_all, filtered_all, inputs, hidden_all


class _Reverse(NamedTuple):
    """What the reverse loop hands to the batched part after it, all [time * batch, ...]."""

    filtered: Tensor  # total gradient by the filtered mean
    error: Tensor  # by the innovation (innovation form), else an alias of filtered
    predicted: Tensor  # by the predicted mean
    inputs: Tensor  # by the input of f
    layers: list[Tensor]  # by each pre-activation
    start: Tensor  # [batch, state], by the belief the sequence starts from


def _run_back(
    steps: _Steps,
    reset: Tensor,
    restart: Tensor | None,
    gain: Tensor,
    hidden: tuple[Tensor, ...],
    grad_filtered: Tensor,
    grad_predicted: Tensor | None,
    error_term: Tensor | None,
    emission: Tensor | None,
) -> _Reverse:
    """Run the recurrence of :func:`_run` backwards.

    ``error_term`` (innovation form) is the gradient of the likelihood by the innovation,
    ``grad_predicted`` what reaches the predicted mean from outside, None for nothing.
    """
    carry = torch.zeros_like(grad_filtered[0])
    g_filtered: list[Tensor] = []
    g_error: list[Tensor] = []
    g_predicted: list[Tensor] = []
    g_inputs: list[Tensor] = []
    g_layers: list[list[Tensor]] = []
    resets, gains = reset.unbind(0), gain.unbind(0)
    restarts = None if restart is None else restart.unbind(0)
    outer = grad_filtered.unbind(0)
    predicted_outer = None if grad_predicted is None else grad_predicted.unbind(0)
    errors = None if error_term is None else error_term.unbind(0)
    layers = [h.unbind(0) for h in hidden]
    for t in range(len(outer) - 1, -1, -1):
        g = outer[t] + carry
        g_filtered.append(g)
        if emission is not None and errors is not None:
            # innovation v = y - H m enters the mean through the gain and the likelihood directly
            ge = torch.baddbmm(errors[t].unsqueeze(2), gains[t], g.unsqueeze(2)).squeeze(2)
            g_error.append(ge)
            g = torch.addmm(
                g if predicted_outer is None else g + predicted_outer[t], ge, emission, alpha=-1
            )
        else:
            base = g if predicted_outer is None else g + predicted_outer[t]
            g = torch.baddbmm(base.unsqueeze(1), g.unsqueeze(1), gains[t], alpha=-1).squeeze(1)
        g_predicted.append(g)
        g = torch.where(resets[t], 0.0, g)
        g, by_layer = steps.backward(g, tuple(h[t] for h in layers))
        g_layers.append(by_layer)
        g_inputs.append(g)
        carry = g if restarts is None else torch.where(restarts[t], 0.0, g)

    def stack(rows: list[Tensor]) -> Tensor:
        return torch.stack(rows[::-1]).flatten(0, 1)

    filtered = stack(g_filtered)
    return _Reverse(
        filtered,
        stack(g_error) if g_error else filtered,
        stack(g_predicted),
        stack(g_inputs),
        [stack([g[i] for g in g_layers]) for i in range(len(g_layers[0]))],
        carry,
    )


def _spd_inverse(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse and the log-determinant of a batch of SPD matrices.

    One item that fails (it cannot while the noise floors hold) turns into NaN by itself instead
    of failing the whole batch, without a synchronisation or a branch.
    """
    found = spd_inverse(matrix)
    if found is not None:
        return found
    factor, info = torch.linalg.cholesky_ex(matrix)
    failed = (info != 0).unsqueeze(-1)
    # cholesky_inverse refuses a zero on the diagonal; only the diagonal is touched, it is small
    diagonal = factor.diagonal(dim1=-2, dim2=-1)
    diagonal.masked_fill_(failed, 1.0)
    inverse = torch.cholesky_inverse(factor).mT  # symmetric; LAPACK's result is column-major
    inverse += torch.zeros_like(diagonal[..., :1]).masked_fill_(failed, torch.nan)[..., None]
    log_det = 2.0 * diagonal.log().sum(-1)
    return inverse, log_det


class InnovationRecurrence(torch.autograd.Function):
    """mean_t = m_t + G_t A_t^-1 (y_t - H m_t) and its log-likelihood, obs x obs factorised.

    The covariances come in float64: A_t is as ill-conditioned as signal over noise, and where H is
    of low rank float32 would lose most digits of its inverse. The gain is well scaled and goes back
    to the loop's dtype.
    """

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return predicted mean, filtered mean and log-likelihood (without its 2 pi term)."""
        (residual, activation, y, observed, reset, restart, restart_mean, start, drive) = args[:9]
        initial_mean, H, cov, initial_cov, cross, initial_cross, first, *rest = args[9:]
        steps = _Steps(residual, activation, first, tuple(rest))
        time, batch, obs = y.shape
        state = start.shape[-1]

        # Masking by products and lerp with weights of exactly 0 or 1: the same numbers as
        # torch.where, which costs several times as much on these, the largest tensors here.
        mask = observed.to(cov.dtype)
        both = mask.unsqueeze(-1) * mask.unsqueeze(-2)
        at_reset = reset.to(cov.dtype).unsqueeze(-1)
        masked = torch.lerp(cov, initial_cov, at_reset) * both
        masked.diagonal(dim1=-2, dim2=-1).add_(1.0 - mask)
        inverse, log_det = _spd_inverse(masked)
        inverse = inverse * both
        flat = inverse.view(time * batch * obs, obs)
        shape = (time, batch, obs, state)
        gain = torch.lerp(
            (flat @ cross.t()).view(shape), (flat @ initial_cross.t()).view(shape), at_reset
        ).to(start.dtype)

        predicted, filtered, inputs, hidden = _run(
            steps, drive, start, reset, initial_mean, restart, restart_mean, gain, y, H
        )
        m, mean = torch.stack(predicted), torch.stack(filtered)
        wide_y, wide_m, wide_H = (v.to(cov.dtype) for v in (y, m, H))
        error = torch.addmm(wide_y.flatten(0, 1), wide_m.flatten(0, 1), wide_H.t(), alpha=-1)
        r = torch.where(observed, error.view_as(y), 0.0)
        z = (inverse @ r.unsqueeze(-1)).squeeze(-1)
        ll = (-0.5 * ((z * r).sum(-1) + log_det)).to(start.dtype)

        layers = [torch.stack([h[i] for h in hidden]) for i in range(len(hidden[0]))]
        ctx.save_for_backward(
            reset, restart, inverse, gain, z, m, torch.stack(inputs), H, first, *rest, *layers,
        )  # fmt: skip
        ctx.network = (residual, activation, len(rest))
        ctx.set_materialize_grads(False)
        return m, mean, ll

    @staticmethod
    @outside_autocast
    @once_differentiable
    def backward(
        ctx: Any, g_m: Tensor | None, g_mean: Tensor | None, g_ll: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        """Return the gradient of every input of ``forward``, in its order."""
        reset, restart, inverse, gain, z, m, inputs, H, first = ctx.saved_tensors[:9]
        residual, activation, count = ctx.network
        rest, layers = ctx.saved_tensors[9 : 9 + count], ctx.saved_tensors[9 + count :]
        steps = _Steps(residual, activation, first, rest)
        obs = z.shape[-1]

        g_mean = torch.zeros_like(m) if g_mean is None else g_mean
        g_ll = torch.zeros_like(m[..., 0]) if g_ll is None else g_ll
        by_ll = (-g_ll.unsqueeze(-1) * z).to(m.dtype)  # d ll / d r = -z
        back = _run_back(steps, reset, restart, gain, layers, g_mean, g_m, by_ll, H)

        g_e = back.error  # by the innovation: u - g_ll z, with u = M A^-1 G' g
        zf, mf = z.flatten(0, 1), m.flatten(0, 1)
        half = 0.5 * g_ll.reshape(-1, 1)
        # dA = g_ll/2 (z z' - A^-1) - u z'  =  -(u - g_ll z) z' - g_ll/2 (z z' + A^-1)
        left = -(g_e + half * zf)
        was_reset = reset.reshape(-1, 1)

        def split(rows: Tensor) -> tuple[Tensor, Tensor]:
            """Keep the rows of ordinary steps, and those of episode starts."""
            return torch.where(was_reset, 0.0, rows), torch.where(was_reset, rows, 0.0)

        flat_inverse = inverse.reshape(-1, obs * obs)
        g_cov, g_cross = [], []
        outer = back.filtered.to(z.dtype)
        for left_i, half_i, g_i in zip(
            split(left), split(half.to(z.dtype)), split(outer), strict=True
        ):
            by_cov = left_i.t() @ zf - (half_i.t() @ flat_inverse).view(obs, obs)
            g_cov.append(0.5 * (by_cov + by_cov.t()))
            g_cross.append(g_i.t() @ zf)

        g_initial_mean = torch.where(was_reset, back.predicted, 0.0).sum(0)
        g_restart = None
        if restart is not None:
            g_restart = torch.where(restart, back.inputs.view_as(m), 0.0)
        weights = steps.weight_grads(
            inputs.flatten(0, 1), [h.flatten(0, 1) for h in layers], back.layers
        )
        return (
            None, None, g_e.view_as(z), None, None, None, g_restart, back.start,
            back.layers[0].view(*m.shape[:2], -1), g_initial_mean, -(g_e.t() @ mf),
            g_cov[0], g_cov[1], g_cross[0], g_cross[1], *weights,
        )  # fmt: skip


class InformationRecurrence(torch.autograd.Function):
    """mean_t = C_t (H'W_t y_t + L_t m_t), C_t = (L_t + H'W_t H)^-1, and its log-likelihood.

    W_t = diag(observed / R), L_t the inverse of the predicted covariance: state x state
    factorised. What is inverted stays in float64: in float32 with R at its floor it would lose most
    digits. The loop needs D_t = C_t H'W_t H = I - C_t L_t and c_t = C_t H'W_t y_t alone, which are
    well scaled and go back to its dtype.

    The filtered mean maximises the likelihood's quadratic form, so that form's gradient reaches the
    predicted mean only, as L_t (mean_t - m_t), and no gradient of a factorisation is taken.
    """

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor]:
        """Return filtered mean and log-likelihood (float64, without log|predicted covariance|)."""
        (residual, activation, y, observed, H, noise, prior, initial_prior) = args[:8]
        reset, restart, restart_mean, start, drive, initial_mean, first, *rest = args[8:]
        steps = _Steps(residual, activation, first, tuple(rest))
        time, batch = y.shape[:2]
        state = start.shape[-1]

        mask = observed.to(H.dtype)
        weight = (mask / noise).flatten(0, 1)
        y = y.to(H.dtype).flatten(0, 1)
        # Weights of exactly 0 or 1 choose exactly.
        at_reset = reset.to(H.dtype).reshape(-1, 1, 1)
        before = torch.lerp(prior, initial_prior, at_reset)  # L
        # Only the lower triangle of H'WH is computed; the factorisation reads no other entry.
        row, column = torch.tril_indices(state, state, device=H.device)
        products = (H.unsqueeze(-1) * H.unsqueeze(-2))[:, row, column]
        place = torch.zeros(state, state, dtype=torch.int64, device=H.device)
        place[row, column] = torch.arange(len(row), device=H.device)
        precision = (weight @ products).index_select(1, place.flatten()).view(-1, state, state)
        precision += before
        C, log_det = _spd_inverse(precision)
        D = C @ before
        D.neg_().diagonal(dim1=-2, dim2=-1).add_(1.0)
        # Nothing observed: D is 0, which the difference gives to rounding only.
        D *= observed.any(-1).view(-1, 1, 1)
        c = (C @ ((weight * y) @ H).unsqueeze(-1)).squeeze(-1)
        shape = (time, batch, state)
        D, c = D.to(start.dtype).view(*shape, state), c.to(start.dtype).view(shape)
        predicted, filtered, inputs, hidden = _run(
            steps, drive, start, reset, initial_mean, restart, restart_mean, D, c, None
        )
        m, mean = torch.stack(predicted), torch.stack(filtered)

        wide = mean.flatten(0, 1).to(H.dtype)
        delta = wide - m.flatten(0, 1).to(H.dtype)
        left = torch.addmm(y, wide, H.t(), alpha=-1)  # y - H mean
        pull = (before @ delta.unsqueeze(-1)).squeeze(-1)
        quadratic = (weight * left.square()).sum(-1) + (delta * pull).sum(-1)
        log_noise = mask.flatten(0, 1) @ (noise.log() + LOG_2PI)
        ll = (-0.5 * (quadratic + log_noise + log_det)).view(time, batch)

        layers = [torch.stack([h[i] for h in hidden]) for i in range(len(hidden[0]))]
        ctx.save_for_backward(
            reset, restart, C, D, wide, delta, left, pull, weight, H, noise, torch.stack(inputs),
            first, *rest, *layers,
        )  # fmt: skip
        ctx.network = (residual, activation, len(rest))
        ctx.set_materialize_grads(False)
        return mean, ll

    @staticmethod
    @outside_autocast
    @once_differentiable
    def backward(ctx: Any, g_mean: Tensor | None, g_ll: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return the gradient of every input of ``forward``, in its order."""
        reset, restart, C, D, wide, delta, left, pull, weight, H, noise = ctx.saved_tensors[:11]
        inputs, first = ctx.saved_tensors[11:13]
        residual, activation, count = ctx.network
        rest, layers = ctx.saved_tensors[13 : 13 + count], ctx.saved_tensors[13 + count :]
        steps = _Steps(residual, activation, first, rest)
        time, batch, state = inputs.shape
        flat = (time * batch, state)
        g_mean = torch.zeros_like(inputs) if g_mean is None else g_mean
        g = torch.zeros_like(pull[:, :1]) if g_ll is None else g_ll.reshape(-1, 1)
        by_m = (g * pull).to(inputs.dtype).view_as(inputs)
        back = _run_back(steps, reset, restart, D, layers, g_mean, by_m, None, None)

        p = (C @ back.filtered.to(C.dtype).unsqueeze(-1)).squeeze(-1)  # by H'Wy + L m
        Hp = p @ H.t()
        v = weight * (g * left - Hp)  # minus the gradient by y
        # sum_t g_t w_ti C_t, for every sensor i at once; C is well scaled, its dtype the loop's.
        spread = (g * weight).to(inputs.dtype).t() @ C.view(flat[0], -1).to(inputs.dtype)
        spread = (spread.view(-1, state, state) @ H.to(spread.dtype).unsqueeze(-1)).squeeze(-1)
        spread = spread.to(H.dtype)
        g_H = torch.addmm((weight * left).t() @ p, v.t(), wide).sub_(spread)
        per_entry = weight * (left * (0.5 * g * left - Hp) - 0.5 * g * noise)
        g_noise = (per_entry.sum(0) + 0.5 * (H * spread).sum(-1)) / noise

        was_reset = reset.reshape(-1, 1)
        half = 0.5 * g
        rows = -(p + half * delta)
        g_priors = []
        for chosen in (~was_reset, was_reset):
            by = torch.where(chosen, rows, 0.0).t() @ delta
            both = torch.where(chosen, half, 0.0).t() @ C.view(flat[0], -1)
            by = by - both.view(state, state)
            g_priors.append(0.5 * (by + by.t()))
        g_initial_mean = torch.where(was_reset, back.predicted, 0.0).sum(0)
        g_restart = None
        if restart is not None:
            g_restart = torch.where(restart, back.inputs.view_as(inputs), 0.0)
        weights = steps.weight_grads(
            inputs.flatten(0, 1), [h.flatten(0, 1) for h in layers], back.layers
        )
        return (
            None, None, (-v).to(inputs.dtype).view(time, batch, -1), None, g_H, g_noise, *g_priors,
            None, None, g_restart, back.start, back.layers[0].view(time, batch, -1),
            g_initial_mean, *weights,
        )  # fmt: skip
