"""Conditions and methods as text: what stands in tables and figures, and on the command line."""

import math
from collections.abc import Callable, Mapping
from typing import Any


def _number(least: float = 0.0, most: float = math.inf) -> Callable[[str], float]:
    def read(text: str) -> float:
        value = float(text)
        if not (least <= value <= most and math.isfinite(value)):
            raise ValueError(text)
        return value

    return read


def _one_of(*words: str) -> Callable[[str], str]:
    return lambda text: words[words.index(text)]


_SHARE = _number(most=1.0)
_GROUP_BY = ("group_by", _one_of("sensor", "joint", "kind"), "sensor")
# Of each family what follows its name: a key of conf, how it is read, and what it is where the text
# ends before; without that it must be there. None and False end the text.
FIELDS: dict[str, tuple[tuple[Any, ...], ...]] = {
    **dict.fromkeys(("none", "mcar", "mar", "nmar"), (("eta", _SHARE),)),
    "outages": (("eta", _SHARE), ("mean_length", _number()), _GROUP_BY),
    "delay": (
        *(("delay", int), ("max_delay", int, None), _GROUP_BY),
        ("in_order", lambda text: bool(_one_of("in_order")(text)), False),
    ),
    "multi_rate": (("period", int), _GROUP_BY, ("phase", int, None)),
    "reduction": (("ratio", _SHARE), ("selection", _one_of("model", "random"))),
    "noise": (("sigma", _number()),),
    "spikes": (("spike_probability", _SHARE), ("spike_std", _number(), 5.0)),
    "stuck": (("stuck_probability", _SHARE), ("stuck_mean_length", _number(), 20.0), _GROUP_BY),
    "drift": (("drift_std", _number()), ("drift_rate", _number(-math.inf), 0.0)),
}
# By these a run's noise has a fault beside white noise.
FAULTS = {
    "spikes": ("spike_probability",),
    "stuck": ("stuck_probability",),
    "drift": ("drift_std", "drift_rate"),
}


def read_fields(family: str, words: list[str]) -> dict[str, Any] | None:
    """Read what follows the name of a family; None where it can't be read."""
    fields = FIELDS.get(family, ())
    try:
        given = {field[0]: field[1](word) for field, word in zip(fields, words, strict=False)}
        rest = {field[0]: field[2] for field in fields[len(words) :]}
    except (ValueError, IndexError):
        return None
    return given | rest if fields and len(words) <= len(fields) else None


def condition_name(family: str, values: Mapping[str, Any]) -> str:
    """Return a condition in full, such as ``outages:0.5:20:sensor``."""
    words = [family]
    for key, *_ in FIELDS[family]:
        value = values.get(key)
        if value is None or value is False:
            break
        words.append(key if value is True else f"{value:g}" if type(value) is float else str(value))
    return ":".join(words)


def missingness_kind(node: Mapping[str, Any]) -> str:
    """Return what makes entries go missing: ``none``, ``mar``, ``outages``, or one's own target."""
    for kind, key in (("delay", "delay"), ("multi_rate", "period"), ("outages", "mean_length")):
        if key in node and "group_by" in node:
            return kind
    if node.get("eta") == 0:
        return "none"
    return str(node.get("mechanism") or node["_target_"].rpartition(".")[2])


def missingness_name(node: Mapping[str, Any]) -> str:
    """Return missingness as a condition that recipes/evaluate.py reads, such as ``mcar:0.5``."""
    kind, label = missingness_kind(node), f"{node['name']} " if node.get("name") else ""
    if kind in FIELDS:
        return label + condition_name(kind, node)
    return label + (f"{kind}:{node['eta']}" if "eta" in node else kind)


def faults_name(node: Mapping[str, Any]) -> str:
    """Return what is wrong with readings beside white noise, such as `` spikes:0.05:5``."""
    found = [family for family, keys in FAULTS.items() if any(node.get(key) for key in keys)]
    return "".join(f" {condition_name(family, node)}" for family in found)


def method_name(config: Mapping[str, Any]) -> str:
    """Name the method of a run: ``method``, else its belief, and the algorithm if not PPO."""
    if config.get("method"):
        return str(config["method"])
    belief, algo = (str(config.get(group, {}).get("name", "")) for group in ("belief", "algo"))
    return belief if algo in ("", "ppo") else f"{belief} ({algo})"
