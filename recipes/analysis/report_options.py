"""What a report depends on beside its runs, kept beside it so that it can be made again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml
from training.errors import UserError

OPTIONS_FILE = "report.yaml"


@dataclass(frozen=True)
class Options:
    """Options of a report; see conf/report.yaml.

    Attributes:
        title: heading of the page; None: the name of its folder.
        rows: of training.csv for each run.
        unfinished: whether runs that have not come to their end are taken.
    """

    title: str | None = None
    rows: int = 100
    unfinished: bool = False

    def words(self) -> list[str]:
        """Return the options as arguments of the command line; a title in Hydra's quotes."""
        words = [f"rows={self.rows}"]
        if self.title is not None:
            quoted = self.title.replace("\\", "\\\\").replace('"', '\\"')
            words.append(f'title="{quoted}"')
        if self.unfinished:
            words.append("unfinished=true")
        return words

    def text(self) -> str:
        """Return the content of report.yaml."""
        return yaml.safe_dump(asdict(self), sort_keys=False, allow_unicode=True, width=1000)


def read_options(given: Mapping[str, Any], out: Path) -> Options:
    """Return the options of a report: what is given, else what the last report there had.

    Args:
        given: by name; an absent one or None is not given.
        out: folder of the report.

    Returns:
        The options.

    Raises:
        UserError: if report.yaml can't be read, or an option makes no sense.
    """
    path = out / OPTIONS_FILE
    kept: Any = {}
    if path.is_file():
        try:
            kept = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError):
            kept = None
    names = set(asdict(Options()))
    if not isinstance(kept, dict) or not set(kept) <= names:
        raise UserError(f"`{path}` must hold {', '.join(sorted(names))}: remove it to start anew.")
    now = {name: given[name] for name in names if given.get(name) is not None}
    options = Options(**{**kept, **now})
    if isinstance(options.rows, bool) or not isinstance(options.rows, int) or options.rows < 2:
        raise UserError(f"`rows` must be 2 or more, got {options.rows}.")
    return Options(
        None if options.title is None else str(options.title),
        options.rows,
        bool(options.unfinished),
    )
