"""Natural-gradient steps with Kronecker-factored curvature inside a trust region.

No library has these steps: curvlinops and nngeometry have no running average and no step, singd
estimates the curvature from the gradients of the loss itself.

[K-FAC] J. Martens and R. Grosse, Optimizing Neural Networks with Kronecker-factored Approximate
Curvature, ICML 2015. [ACKTR] Y. Wu et al., Scalable trust-region method for deep reinforcement
learning using Kronecker-factored approximation, NeurIPS 2017.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn


def kronecker_factors(inputs: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two factors of the Fisher matrix of a linear layer.

    ``F ~ A (x) G`` with ``A = E[a a']``, ``G = E[g g']`` ([K-FAC], section 3): ``a`` is an input
    ``(samples, in)`` of the layer with a 1 appended for its bias, ``g`` the score
    ``(samples, out)``, the gradient of the log-density of a target *drawn from the model*, with
    respect to the layer's output. The product is exact where ``a`` and ``g`` are independent.
    """
    extended = torch.cat([inputs, inputs.new_ones(inputs.shape[0], 1)], -1)
    count = inputs.shape[0]
    return extended.T @ extended / count, scores.T @ scores / count


def solve_kronecker(gradient: Tensor, a: Tensor, g: Tensor, damping: float) -> Tensor:
    """Return ``(A (x) G + damping I)^-1`` times a gradient, shape ``(out, in + 1)``.

    With ``A = U diag(e) U'`` and ``G = V diag(f) V'`` the product has the eigenvalues ``f_i e_j``
    ([K-FAC], section 4.2), so that the damping is that of the whole matrix, not of its factors.
    """
    e, u = torch.linalg.eigh(a)
    f, v = torch.linalg.eigh(g)
    # Rounding can leave the smallest eigenvalues of a rank-deficient factor just under 0.
    values = torch.outer(f.clamp_min(0), e.clamp_min(0)) + damping
    return v @ ((v.T @ gradient @ u) / values) @ u.T


class KFAC(torch.optim.Optimizer):
    """Descend along the natural gradient, no further than a trust region allows.

    With ``h`` the gradient, ``F`` the running Fisher matrix, block-diagonal over layers, and
    ``u = (F + damping I)^-1 h``, the step ``lr * s * u`` has the predicted divergence
    ``KL ~ (lr s)^2 u'(F + damping I)u / 2 = (lr s)^2 h'u / 2``; ``s = min(1, sqrt(2 max_kl / (lr^2
    h'u)))`` holds it to ``max_kl`` ([ACKTR], section 3.3). Steps are averaged by momentum:
    ``v <- momentum v + s u``, ``parameter <- parameter - lr (1 - momentum) v``.

    All of ``module`` must be ``nn.Linear`` layers with a bias, and parameters in
    ``constant_fisher`` with the Fisher information of their components: 2 for the log of a standard
    deviation. ``decay`` is that of the running averages of the factors.
    """

    def __init__(
        self,
        module: nn.Module,
        *,
        lr: float,
        momentum: float,
        damping: float,
        decay: float,
        max_kl: float,
        constant_fisher: Mapping[nn.Parameter, float] | None = None,
    ) -> None:
        for name, value in {"lr": lr, "damping": damping, "max_kl": max_kl}.items():
            if not value > 0:
                raise ValueError(f"`{name}` must be positive, got {value}.")
        for name, value in {"momentum": momentum, "decay": decay}.items():
            if not 0 <= value < 1:
                raise ValueError(f"`{name}` must lie in [0, 1), got {value}.")
        self._layers = [m for m in module.modules() if isinstance(m, nn.Linear)]
        constant = dict(constant_fisher or {})
        groups: list[dict[str, Any]] = [
            {"params": list(layer.parameters()), "fisher": None} for layer in self._layers
        ]
        groups += [{"params": [p], "fisher": fisher} for p, fisher in constant.items()]
        known = {p for group in groups for p in group["params"]}
        left = [name for name, p in module.named_parameters() if p not in known]
        no_bias = any(layer.bias is None for layer in self._layers)
        if left or no_bias:
            raise ValueError(
                f"`module` must hold linear layers with biases and parameters of constant Fisher "
                f"information alone, got {', '.join(left) or 'a layer without bias'}."
            )
        super().__init__(groups, {"lr": lr, "momentum": momentum})
        self.damping, self.decay, self.max_kl = damping, decay, max_kl
        self._recorded: list[tuple[Tensor, Tensor]] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Note inputs and outputs of the layers; one forward pass belongs inside."""
        self._recorded = []

        def note(_: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
            self._recorded.append((inputs[0].detach(), output))

        hooks = [layer.register_forward_hook(note) for layer in self._layers]
        try:
            yield
        finally:
            for hook in hooks:
                hook.remove()

    def observe(self, output: Tensor, score: Tensor) -> None:
        """Take the recorded pass into the running curvature; its graph stays for the loss.

        ``score`` is the gradient of the log-density with respect to ``output``, ``(samples, out)``,
        of targets drawn from the model: ``noise / std`` for a Gaussian of mean ``output``.
        """
        outputs = [out for _, out in self._recorded]
        scores = torch.autograd.grad(output, outputs, score, retain_graph=True)
        for layer, (inputs, _), g in zip(self._layers, self._recorded, scores, strict=True):
            factors = kronecker_factors(inputs.flatten(0, -2), g.flatten(0, -2))
            state = self.state[layer.weight]
            if "observations" not in state:
                state["observations"] = 0  # not a tensor: loading would give it the layer's dtype
                state["a"], state["g"] = map(torch.zeros_like, factors)
            state["observations"] += 1
            for key, factor in zip(("a", "g"), factors, strict=True):
                state[key].lerp_(factor, 1 - self.decay)
        self._recorded = []

    @torch.no_grad()
    def step(self, closure: None = None) -> Tensor:  # type: ignore[override]
        """Step along the natural gradient of what ``grad`` holds; return its predicted KL, nats."""
        del closure
        moves, product = [], torch.zeros(())
        for group in self.param_groups:
            gradients = [p.grad for p in group["params"]]
            if len(gradients) == 2:  # of a weight and its bias
                gradients = [torch.cat([gradients[0], gradients[1].unsqueeze(-1)], -1)]
            gradient = gradients[0]
            move = self._natural(group, gradient)
            moves.append(move)
            product = product + (gradient * move).sum() * group["lr"] ** 2 / 2
        scale = (self.max_kl / product).sqrt().clamp_max(1.0)
        for group, move in zip(self.param_groups, moves, strict=True):
            state = self.state[group["params"][0]]
            velocity = state.setdefault("velocity", torch.zeros_like(move))
            velocity.mul_(group["momentum"]).add_(move * scale)
            change = velocity * (-group["lr"] * (1 - group["momentum"]))
            parts = [change] if len(group["params"]) == 1 else [change[:, :-1], change[:, -1]]
            for parameter, part in zip(group["params"], parts, strict=True):
                parameter.add_(part)
        return product * scale**2

    def _natural(self, group: dict[str, Any], gradient: Tensor) -> Tensor:
        """Return (F + damping I)^-1 times the gradient of one layer or constant parameter."""
        if group["fisher"] is not None:
            return gradient / (group["fisher"] + self.damping)
        state = self.state[group["params"][0]]
        if "observations" not in state:
            raise RuntimeError("`step` needs a curvature: call `observe` first.")
        # The averages began at 0, as Adam's do.
        weight = 1 - self.decay ** state["observations"]
        return solve_kronecker(gradient, state["a"] / weight, state["g"] / weight, self.damping)
