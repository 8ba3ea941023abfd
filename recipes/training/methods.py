"""What the method of a run is called in tables and figures."""

from __future__ import annotations

from collections.abc import Mapping
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
