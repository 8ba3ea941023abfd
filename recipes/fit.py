"""Fit the filter to a log: ``python recipes/fit.py data=log.csv 'observation=[x,y]' episode=run``.

No reinforcement learning: a table with a row a step, gaps in it. Whole episodes are held out, some
of their readings are hidden, and estimates of these are compared: the filter, a linear Kalman
filter fitted by the same likelihood, the last value. Leaves table.csv, estimates.png and
filter.safetensors, from which ``belief.pretrained=`` of ppo_drbpn.py starts.
"""

import copy
from math import inf
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pandas as pd
import torch
from estimation.fitting import INTERVALS, Estimate, Sequences, estimates, fit, hide, rows, split
from estimation.logs import read_log
from evaluation.folders import override
from matplotlib.figure import Figure
from rendering.style import STYLE, legend_below, panel_grid, save_figure
from safetensors.torch import save_file
from tensordict import TensorDict
from training.config import build, check_limits, command
from training.console import log_line
from training.errors import UserError
from training.run_folder import write_table

from torchrl_drbpn import BeliefFilter, MaskedObservationNorm

_FILTER, _LINEAR = "filter", "linear Kalman filter"
_WHOLE = dict.fromkeys(("steps", "sequence_length", "batch_size", "patience"), (1, inf))
_LIMITS = {
    **dict.fromkeys(("hold_out", "hide"), (0.01, 0.99)),
    **dict.fromkeys(("lr", "max_grad_norm"), (1e-9, inf)),
    "weight_decay": (0, inf),
}
_TRAINING = (*("steps", "batch_size", "lr", "weight_decay", "max_grad_norm", "patience", "seed"),)
_SHOWN_STEPS, _SHOWN_SENSORS = 200, 4


def run(config: dict[str, Any]) -> int:
    """Fit, compare and write; see conf/fit.yaml."""
    check_limits(config, _WHOLE, whole=True)
    check_limits(config, _LIMITS)
    if config["belief"].get("pretrained"):
        raise UserError("`belief.pretrained` is what this command makes; leave it out.")
    if config["belief"].get("mask_model"):
        raise UserError("`belief.mask_model` must be false: what is hidden here has no reason.")
    if "transition" not in config["belief"]:
        name = config["belief"]["name"]
        raise UserError(f"`belief` must be drbpn or drbpn_propagated here, got {name}.")
    if config["out"] is None or Path(config["out"]).is_file():
        raise UserError(f"`out` must be a folder, such as fits/arm, got {config['out']}.")
    records = read_log(
        config["data"], _list(config["observation"]), _list(config["action"]), config["episode"]
    )
    if len(records.episodes) < 2:
        raise UserError(f"`episode` must tell two episodes apart at least, got {records.episodes}.")
    torch.set_num_threads(config["threads"])
    torch.manual_seed(config["seed"])
    train, validation, test = split(len(records.episodes), config["hold_out"], config["seed"])
    norm = MaskedObservationNorm(len(records.names))
    known = torch.unique(torch.cat([train, validation]))
    episodes = {"observation": records.observation[known], "observed": records.observed[known]}
    norm.update(TensorDict(episodes, batch_size=records.reset[known].shape))
    if (norm.count < 2).any():
        name = records.names[int(norm.count.argmin())]
        raise UserError(f"column `{name}` has no readings outside the held-out episodes.")
    x = norm.normalize(records.observation, records.observed).float()
    data = Sequences(records.previous_action, x, records.observed, records.reset)
    filters = {}
    linear = copy.deepcopy(config["belief"])
    linear["transition"]["hidden_sizes"] = []
    for name, settings in ((_FILTER, config["belief"]), (_LINEAR, linear)):
        filters[name] = _fitted(name, settings, data, train, validation, config)
    held = data.rows(test)
    try:
        hidden = hide(held.observed, config["hide"], config["hide_length"], config["seed"])
    except ValueError as error:
        raise UserError(f"`hide`, `hide_length`: {error}") from error
    if not hidden.any():
        raise UserError("`hold_out`: the held-out episodes have no readings to hide.")
    shown = held._replace(observed=held.observed & ~hidden)
    found = estimates(filters, shown)
    out = Path(config["out"])
    out.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows(found, held.observation, hidden, records.names, norm.std))
    write_table(out / "table.csv", table)
    figure = _figure(found, held, hidden, records.names, [records.episodes[i] for i in test])
    save_figure(figure, out / "estimates.png", dpi=90, palette=True)
    weights = {f"norm.{k}": v for k, v in norm.state_dict().items()}
    weights |= {f"belief.filter.{k}": v for k, v in filters[_FILTER].state_dict().items()}
    save_file(weights, out / "filter.safetensors")
    log_line(
        f"{len(train)} episodes trained on, {len(validation)} to choose the epoch, {len(test)} "
        "held out; of these:"
    )
    overall = table[table["component"] == "all"].drop(columns=["component", "rmse"])
    log_line(overall.to_string(index=False, float_format="%.3f", na_rep=""))
    start = override("belief.pretrained", out / "filter.safetensors")
    log_line(
        f"written: {out}; an agent starts from it by belief={config['belief']['name']} {start}"
    )
    return 0


def _list(names: Any) -> list[str]:
    return [str(names)] if isinstance(names, str | int) else list(names or [])


def _fitted(
    name: str,
    settings: dict[str, Any],
    data: Sequences,
    train: torch.Tensor,
    validation: torch.Tensor,
    config: dict[str, Any],
) -> BeliefFilter:
    sizes = {"obs_dim": data.observation.shape[-1], "action_dim": data.previous_action.shape[-1]}
    belief_filter: BeliefFilter = build("belief", dict(settings), **sizes).module.filter
    how = {key: config[key] for key in _TRAINING} | {"length": config["sequence_length"]}
    history = list(fit(belief_filter, data.rows(train), data.rows(validation), **how))
    log_line(
        f"{name}: {max(history):.3f} nats an entry on validation episodes, epoch "
        f"{history.index(max(history)) + 1} of {len(history)}"
    )
    return belief_filter


def _figure(
    found: dict[str, Estimate],
    held: Sequences,
    hidden: torch.Tensor,
    names: list[str],
    episodes: list[str],
) -> Figure:
    """Draw the sensors that were hidden most, in the episode of which most was hidden."""
    episode = int(hidden.flatten(1).sum(1).argmax())
    steps = range(min(_SHOWN_STEPS, int((~held.reset[episode]).sum()) + 1))
    sensors = hidden[episode, : len(steps)].sum(0).argsort(descending=True)[:_SHOWN_SENSORS]
    with mpl.rc_context(STYLE):
        figure, axes = panel_grid(len(sensors), 1, (9.0, 1.5))
        for axis, sensor in zip(axes[:, 0], sorted(sensors.tolist()), strict=True):
            part = episode, slice(len(steps)), sensor
            truth, gone = held.observation[part], hidden[part]
            mean, std = found[_FILTER].mean[part], found[_FILTER].std
            spread = INTERVALS["coverage_90"] * (std[part] if std is not None else 0 * mean)
            axis.fill_between(
                steps, mean - spread, mean + spread, color="#1f6fb4", alpha=0.2, lw=0,
                label="filter, 90 % interval",
            )  # fmt: skip
            axis.plot(steps, mean, color="#1f6fb4", lw=1, label=_FILTER)
            linear = found[_LINEAR].mean[part]
            axis.plot(steps, linear, color="#d1622b", lw=0.8, ls="--", label=_LINEAR)
            looks: Any = {"ls": "", "marker": "o", "ms": 2.5, "color": "#222222"}
            arrived = held.observed[part] & ~gone
            axis.plot(torch.tensor(steps)[arrived], truth[arrived], label="arrived", **looks)
            looks |= {"mfc": "white", "mew": 0.7}
            axis.plot(torch.tensor(steps)[gone], truth[gone], label="hidden", **looks)
            axis.set_title(names[sensor])
        axes[-1, 0].set_xlabel(f"step of held-out episode {episodes[episode]}")
        figure.supylabel("standard deviations of the sensor", fontsize=9.5)
        legend_below(figure, 5)
    return figure


if __name__ == "__main__":
    command("fit", run)
