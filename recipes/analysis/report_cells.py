"""How the tables of a page write a number, an interval, a share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_LARGEST_MARGIN = 10  # that is told as a share; the CSV files hold every number


def number(value: float | None) -> str:
    """Return a number with about three digits; nothing for None.

    Args:
        value: it.

    Returns:
        Its text.
    """
    if value is None:
        return ""
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}"


def with_interval(row: Mapping[str, Any]) -> str:
    """Return an interquartile mean in bold, and its interval where there is one.

    Args:
        row: with ``iqm, low, high``.

    Returns:
        Such as ``**51.00** [50.00, 52.00]``; ``**none**`` where a seed has no number.
    """
    mean = "none" if row["iqm"] is None else number(row["iqm"])
    if row["low"] is None:
        return f"**{mean}**"
    return f"**{mean}** [{number(row['low'])}, {number(row['high'])}]"


def percent(share: float) -> str:
    """Return a share in per cent, with its sign.

    Args:
        share: 1 is the whole.

    Returns:
        Such as ``+20 %``.
    """
    return f"{100 * share:+.0f} %"


def margin(row: Mapping[str, Any]) -> str:
    """Return a margin, and its interval where there is one.

    Args:
        row: with ``margin, low, high``, shares.

    Returns:
        Such as ``+20 % [+5 %, +41 %]``; ``over 10 x`` from eleven times on: the other's return is
        then so near 0 that its share is noise.
    """
    if row["margin"] > _LARGEST_MARGIN:
        return f"over {_LARGEST_MARGIN} x"
    if row["low"] is None:
        return percent(row["margin"])
    return f"{percent(row['margin'])} [{percent(row['low'])}, {percent(row['high'])}]"


def two_steps(row: Mapping[str, Any]) -> str:
    """Return the environment steps of two methods that are compared.

    Args:
        row: with ``steps`` and ``steps_over``.

    Returns:
        One number, or two where they differ.
    """
    if row["steps"] == row["steps_over"]:
        return f"{row['steps']:,.0f}"
    return f"{row['steps']:,.0f} and {row['steps_over']:,.0f}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table.

    Args:
        head: names of columns.
        rows: cells.

    Returns:
        Its lines.
    """
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
