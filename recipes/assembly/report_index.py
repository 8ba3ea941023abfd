"""results/README.md: every study in a few lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from assembly.errors import UserError

_HEAD = """# Results

One folder a study, each made by one command from finished run folders, none left out. Its
`README.md` holds the tables, the commands from nothing to the page, and the versions; the CSV files
beside it hold every seed's own numbers and what the figures were drawn from.

This page, and every table below it, byte for byte from the run folders in `<study>/runs`:

```bash
python recipes/report.py index=results
```

The run folders hold their last checkpoints, so that an agent can be looked at without training it:

```bash
python recipes/plot_belief.py run=results/<study>/runs/<run> point=mcar:0.7
```
"""


def studies_of(folder: Path) -> list[Path]:
    """Return the studies of a folder that hold their runs.

    Args:
        folder: such as results/.

    Returns:
        Their folders, sorted.

    Raises:
        UserError: if there is none.
    """
    if not folder.is_dir():
        raise UserError(f"`index` must be a folder of studies, there is no folder {folder}.")
    found = sorted(path.parent for path in folder.glob("*/runs") if path.is_dir())
    if not found:
        raise UserError(
            f"`index` must be a folder of studies that hold their run folders in <study>/runs; "
            f"{folder} holds none."
        )
    return found


def index_page(folder: Path, studies: Sequence[Path]) -> str:
    """Write the page over all studies.

    Args:
        folder: in which it lies.
        studies: folders of it with a report.

    Returns:
        Markdown: for each study its heading, and the first paragraph of its notes.md.
    """
    parts = [_HEAD.strip()]
    for study in studies:
        lines = (study / "README.md").read_text(encoding="utf-8").splitlines()
        parts.append(f"## [{lines[0].removeprefix('# ')}]({study.relative_to(folder)}/README.md)")
        notes = study / "notes.md"
        if notes.is_file():
            parts.append(notes.read_text(encoding="utf-8").strip().split("\n\n")[0])
    return "\n\n".join(parts) + "\n"
