"""What the method of a run is called in tables and figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any


def method_name(config: Mapping[str, Any]) -> str:
    """Name the method of a run.

    Args:
        config: its configuration, plain containers.

    Returns:
        Its key ``method``; where that is null, its belief, and the algorithm where it is not PPO,
        such as ``none (acktr)``.
    """
    if config.get("method"):
        return str(config["method"])
    belief, algo = (str(config.get(group, {}).get("name", "")) for group in ("belief", "algo"))
    return belief if algo in ("", "ppo") else f"{belief} ({algo})"


def training_labels(
    kinds: Iterable[tuple[str, str, float]],
) -> dict[tuple[str, str, float], str]:
    """Label kinds of runs that are drawn together by what distinguishes them.

    Args:
        kinds: method, corruption in training, sigma of the noise in training.

    Returns:
        Labels: the method, with the corruption and the sigma where these differ between the kinds.
    """
    different = list(dict.fromkeys(kinds))
    several_on, several_sigma = (len({kind[i] for kind in different}) > 1 for i in (1, 2))
    return {
        kind: ", ".join([kind[0], *[kind[1]] * several_on, *[f"sigma {kind[2]:g}"] * several_sigma])
        for kind in different
    }
