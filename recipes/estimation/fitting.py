"""Train a filter by the likelihood of logged data, and hold estimates to entries that were hidden.

Readings are standardised here: one unit is one standard deviation of that sensor in the log.
"""

import copy
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn import BeliefFilter
from torchrl_drbpn.functional import Belief, outage_rates, sample_working

INTERVALS = {"coverage_50": 0.6744897501960817, "coverage_90": 1.6448536269514722}


class Sequences(NamedTuple):
    """What a filter reads, float32, shapes ``(rows, time, ...)``; see ``logs.Log``."""

    previous_action: Tensor
    observation: Tensor
    observed: Tensor
    reset: Tensor

    def rows(self, index: Tensor) -> "Sequences":
        """Return some of the rows."""
        return Sequences(*(x[index] for x in self))

    def cut(self, length: int) -> "Sequences":
        """Return windows of a length as rows; what is added at the end is a reset each step."""
        time = self.reset.shape[1]
        added = -time % length
        ends = [torch.cat([x, x.new_zeros(len(x), added, *x.shape[2:])], 1) for x in self]
        ends[-1][:, time:] = True
        return Sequences(*(x.reshape(-1, length, *x.shape[2:]) for x in ends))


class Estimate(NamedTuple):
    """Estimates of every reading, shape ``(rows, time, obs)``; std None: claims none."""

    mean: Tensor
    std: Tensor | None
    log_likelihood: float | None


def split(episodes: int, share: float, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return which episodes are trained on, which choose the epoch, and which are held out."""
    order = torch.randperm(episodes, generator=torch.Generator().manual_seed(seed))
    held = max(1, round(share * episodes))
    test, rest = order[:held], order[held:]
    return (rest[held:], rest[:held], test) if len(rest) > held else (rest, rest, test)


def run(
    belief_filter: BeliefFilter, data: Sequences, before: Belief | None = None
) -> tuple[Belief, Tensor]:
    """Filter sequences, from their own first step or from beliefs before it.

    Returns the belief after each step, and the log-likelihood per observed entry, nats.
    """
    out = belief_filter(*(before or _zero_belief(belief_filter, data)), *data, return_cov=True)
    return Belief(out.mean, out.cov), out.log_likelihood.sum() / data.observed.sum().clamp_min(1)


def _zero_belief(belief_filter: BeliefFilter, data: Sequences) -> Belief:
    """Return the beliefs before a first step, where they are of no account."""
    zero = data.observation.new_zeros(len(data.reset), belief_filter.state_dim)
    return Belief(zero, torch.diag_embed(zero))


def fit(
    belief_filter: BeliefFilter,
    train: Sequences,
    validation: Sequences,
    *,
    steps: int,
    length: int,
    batch_size: int,
    lr: float,
    weight_decay: float,
    max_grad_norm: float,
    patience: int,
    seed: int,
) -> Iterator[float]:
    """Maximise the likelihood; yield that of the validation episodes an epoch, nats an entry.

    Windows start from the beliefs that the filter had there at the start of the epoch. The actions
    are scaled while training, and the scale is folded into the weights behind it. The weights of
    the best epoch stay.
    """
    scale = train.previous_action.square().mean((0, 1)).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    train, validation = (
        data._replace(previous_action=data.previous_action / scale) for data in (train, validation)
    )
    windows = train.cut(length)
    useful = windows.observed.flatten(1).any(1).nonzero().squeeze(1)
    generator = torch.Generator().manual_seed(seed)
    groups: list[dict[str, Any]] = [
        {"params": [], "weight_decay": decay} for decay in (weight_decay, 0.0)
    ]
    for name, parameter in belief_filter.named_parameters():
        decayed = name.startswith("transition") and name.endswith("weight")
        groups[0 if decayed else 1]["params"].append(parameter)
    optimizer = torch.optim.AdamW(groups, lr, eps=1e-5)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 1e-2, total_iters=steps)
    best, kept, done, waited = -torch.inf, copy.deepcopy(belief_filter.state_dict()), 0, 0
    while done < steps and waited < patience:
        starts = _starts(belief_filter, train, length)
        order = useful[torch.randperm(len(useful), generator=generator)]
        for index in torch.split(order, batch_size)[: steps - done]:
            batch = windows.rows(index)
            _, likelihood = run(belief_filter, batch, Belief(*(x[index] for x in starts)))
            optimizer.zero_grad()
            (-likelihood).backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(belief_filter.parameters(), max_grad_norm)
            optimizer.step()
            schedule.step()
            done += 1
        with torch.no_grad():
            found = run(belief_filter, validation)[1].item()
        waited += 1
        if found > best:
            best, kept, waited = found, copy.deepcopy(belief_filter.state_dict()), 0
        yield found
    belief_filter.load_state_dict(kept)
    transition: Any = belief_filter.transition
    with torch.no_grad():
        belief_filter.emission.action_matrix.div_(scale)
        for layers in (transition.layers, transition.cov_layers):
            if layers is not None:
                layers[0].weight[:, belief_filter.state_dim :].div_(scale)


@torch.no_grad()
def _starts(belief_filter: BeliefFilter, data: Sequences, length: int) -> Belief:
    """Return the belief before each window; refresh the Jacobian of a propagated covariance."""
    beliefs, _ = run(belief_filter, data)
    if belief_filter.covariance == "propagated":
        goes_on = ~data.reset[:, 1:]
        action = data.previous_action[:, 1:][goes_on]
        belief_filter.refresh_jacobian(beliefs.mean[:, :-1][goes_on], action)
    mean, cov = (
        torch.cat([torch.zeros_like(x[:, :1]), x[:, length - 1 : -1 : length]], 1).flatten(0, 1)
        for x in beliefs
    )
    return Belief(mean, cov)


def hide(observed: Tensor, share: float, mean_length: float, seed: int) -> Tensor:
    """Return which entries to hide: outages of each sensor, mean length in steps."""
    rates, generator = outage_rates(share, mean_length), torch.Generator().manual_seed(seed)
    working: Tensor | None = None
    shown = torch.ones_like(observed)
    for t in range(observed.shape[1]):
        working = sample_working(working, rates, observed[:, t], generator)
        shown[:, t] = working
    return observed & ~shown


@torch.no_grad()
def estimates(filters: dict[str, BeliefFilter], data: Sequences) -> dict[str, Estimate]:
    """Estimate every reading from those before it, and by the smoother from all."""
    found = {}
    for name, belief_filter in filters.items():
        filtered, likelihood = run(belief_filter, data)
        found[name] = _readings(belief_filter, filtered, data, likelihood.item())
    first, belief_filter = next(iter(filters.items()))
    smoothed = belief_filter.smooth(*_zero_belief(belief_filter, data), *data)
    found[f"{first}, smoothed"] = _readings(belief_filter, smoothed, data, None)
    step = torch.arange(data.reset.shape[1]).view(1, -1, 1).expand_as(data.observation)
    last = torch.where(data.observed, step, -1).cummax(1).values
    value = data.observation.gather(1, last.clamp_min(0))
    found["last value"] = Estimate(torch.where(last < 0, 0.0, value), None, None)
    return found


def _readings(
    belief_filter: BeliefFilter, belief: Belief, data: Sequences, likelihood: float | None
) -> Estimate:
    emission = belief_filter.emission
    H = emission.matrix
    variance = ((H @ belief.cov) * H).sum(-1) + emission.cov().diagonal()
    mean = emission(belief.mean, data.previous_action)
    return Estimate(mean, variance.sqrt(), likelihood)


def rows(
    found: dict[str, Estimate], truth: Tensor, hidden: Tensor, names: list[str], std: Tensor
) -> list[dict[str, Any]]:
    """Return a row a method and component, and one of all components of each method."""
    table = []
    components = [("all", list(range(len(names)))), *((n, [i]) for i, n in enumerate(names))]
    for method, estimate in found.items():
        error = estimate.mean - truth
        for name, chosen in components:
            where, single = hidden[..., chosen], name != "all"
            rmse = error[..., chosen][where].square().mean().sqrt().item()
            row = {
                "method": method,
                "component": name,
                "hidden_entries": int(where.sum()),
                "rmse": rmse * float(std[chosen]) if single else None,
                "rmse_std": rmse,
            }
            for column, bound in INTERVALS.items():
                row[column] = None
                if estimate.std is not None:
                    z = (error / estimate.std)[..., chosen][where].abs()
                    row[column] = (z < bound).float().mean().item()
            row["log_likelihood"] = None if single else estimate.log_likelihood
            table.append(row)
    return table
