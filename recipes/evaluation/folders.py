"""Folders that a command line names."""

import glob
import shlex
from collections.abc import Sequence
from pathlib import Path

from training.console import log_line
from training.errors import UserError


def find_folders(wanted: str | Sequence[str] | None) -> list[Path]:
    """Return run folders, each once, sorted, by their names or patterns (with a config.yaml)."""
    found: list[Path] = []
    for text in [wanted] if isinstance(wanted, str) else wanted or []:
        if Path(text).is_dir():  # no pattern, whatever its name holds
            found.append(Path(text))
            continue
        matches = [Path(path) for path in glob.glob(text, recursive=True)]
        runs = [path for path in matches if (path / "config.yaml").is_file()]
        if not runs:
            raise UserError(f"`run` must name run folders, none is at {text}: look in runs/.")
        found += runs
    if not found:
        raise UserError("`run` must name run folders: run=<folder>, run=[a,b] or 'run=runs/*'.")
    # One folder given twice, by a name and by a pattern, is one run.
    return sorted({path.resolve(): path for path in sorted(found)}.values())


def with_checkpoint(folders: Sequence[Path]) -> list[Path]:
    """Leave out runs before their first checkpoint, unless none has one: reading says it then."""
    kinds = ("checkpoints/frames_*.pt", "*.safetensors")
    found = [folder for folder in folders if any(any(folder.glob(kind)) for kind in kinds)]
    for folder in folders if found else ():
        if folder not in found:
            log_line(f"{folder.name}: left out, it has no checkpoint yet")
    return found or list(folders)


def output_folder(out: str | None, folders: Sequence[Path]) -> Path:
    """Return the folder for tables and figures: ``out``, or the one of the only run."""
    if out is None and len(folders) > 1:
        raise UserError(f"`out` must name a folder for {len(folders)} runs: out=results/<study>.")
    path = Path(out or folders[0])
    if path.exists() and not path.is_dir():
        raise UserError(f"`out` must be a folder, {path} is a file.")
    return path


def override(key: str, value: object) -> str:
    """Return ``key=value`` as a word that can be pasted into a shell, for Hydra to read."""
    text = str(value)
    if not all(c.isalnum() or c in "/_-.+:" for c in text):
        # Hydra reads a backslash as itself, except before a quote.
        text = "'" + text.replace("\\'", "\\\\'").replace("'", "\\'") + "'"
    word = f"{key}={text}"
    plain = not set(word) & set('"$`\\!')  # what a shell reads inside double quotes
    return f'"{word}"' if plain and "'" in word else shlex.quote(word)
