"""What a run leaves on disk: configuration, versions, tables, and a lock while it lasts."""

import fcntl
import importlib.util
import io
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, cast

import pandas as pd
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torchrl.record.loggers import Logger, MLFlowLogger, get_logger
from yaml import YAMLError

from training.config import build
from training.errors import UserError

_PACKAGES = (
    *("torch", "torchrl", "tensordict", "gymnasium", "mujoco", "envpool", "numpy", "hydra-core"),
    "torchrl_drbpn",
)
MAY_CHANGE = ("total_frames", "device", "optim.compile", "logger", "evaluation")  # with resume=
# Of evaluation.csv: one row an evaluation and kind of action.
EVALUATION_COLUMNS = (
    *("frames", "kind", "mode", "episodes", "return_mean", "return_std", "length_mean"),
    *("missing_ratio", "log_likelihood"),
)
_METRICS = (
    *("frames", "episodes", "return", "missing_ratio", "log_likelihood", "loss_objective"),
    *("loss_critic", "loss_entropy", "loss_model", "kl", "clip_fraction", "ess"),
    *("explained_variance", "grad_norm", "action_std", "lr", "engine_resets"),
)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give a file to write to, which takes the name of ``path`` at the end, or goes."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_table(path: Path, rows: Any) -> None:
    """Write a CSV file whole or not at all, numbers with six significant digits."""
    table = pd.DataFrame(rows)
    write_whole(path, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))


def read_table(path: Path, needed: Iterable[str], **options: Any) -> pd.DataFrame:
    """Read a CSV file; a last row without an end was being written, and is left out."""
    try:
        text = path.read_text(encoding="utf-8")
        ended = io.StringIO(text[: text.rfind("\n") + 1])
        table = pd.read_csv(ended, keep_default_na=False, na_values=[""], **options)
    except (OSError, ValueError) as error:
        why = "is it damaged?" if path.exists() else "it is not there."
        raise UserError(f"`{path}` can't be read as a table: {why}") from error
    if absent := [name for name in needed if name not in table]:
        raise UserError(f"`{path}` lacks the columns {', '.join(absent)}: is it another table?")
    return table


class Table:
    """Append rows to a CSV file; rows after ``up_to_frames`` are dropped, None: all of them."""

    def __init__(self, path: Path, columns: Sequence[str], up_to_frames: int | None = None) -> None:
        self.path, self.columns = path, list(columns)
        kept = pd.DataFrame(columns=self.columns)
        if up_to_frames is not None and path.exists():
            rows = read_table(path, ["frames"], dtype=str)
            kept = rows[rows.frames.astype(int) <= up_to_frames].reindex(columns=self.columns)
        write_table(path, kept)

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Append rows; an absent value or None is an empty cell, others are left out."""
        table = pd.DataFrame(rows, columns=self.columns, dtype=object)
        with self.path.open("a", encoding="utf-8") as file:
            table.to_csv(file, header=False, index=False, lineterminator="\n")


def is_evaluated(folder: Path, config: DictConfig) -> bool:
    """Return whether a run has its final evaluation, as its configuration asks for it."""
    wanted, path = config.evaluation, folder / "evaluation.csv"
    if not wanted.final_episodes:
        return True
    if not path.is_file():
        return False
    rows = read_table(path, ["kind", "episodes", "mode"])
    final = rows[(rows["kind"] == "final") & (rows["episodes"] == wanted.final_episodes)]
    return {*wanted.modes} <= {*final["mode"]}


def load_config(folder: Path) -> DictConfig:
    """Read the configuration of a run, to build its parts anew."""
    path = folder / "config.yaml"
    if not path.is_file():
        raise UserError(f"`{folder}` must be a run folder with config.yaml; there is none.")
    try:
        config = OmegaConf.load(path)
    except (YAMLError, OmegaConfBaseException, UnicodeDecodeError, OSError) as error:
        raise UserError(f"`{path}` can't be read as a configuration: is it damaged?") from error
    if not isinstance(config, DictConfig) or "env" not in config:
        raise UserError(f"`{path}` must hold the settings of a run: is it another program's?")
    if OmegaConf.select(config, "env._target_") is None:
        raise UserError(
            f"`{path}` can't be read: it is of version 0.1.0, which the code of commit 2ebd861 "
            "reads."
        )
    return config


def read_config(folder: Path) -> dict[str, Any]:
    """Read the configuration of a run for tables: resolved, as plain containers."""
    return cast(dict[str, Any], OmegaConf.to_container(load_config(folder), resolve=True))


def resumed_config(composed: DictConfig, overrides: Sequence[str], folder: Path) -> DictConfig:
    """Return the configuration of a run that is continued.

    ``overrides`` are the words of the command line that gave ``composed``; one that would change
    the run is refused. A larger ``total_frames`` also stretches what is left of the linear learning
    rate schedule: the run then differs from one that was given the larger number from the start.
    """
    config = load_config(folder)
    for word in overrides:
        name = word.split("=", 1)[0].lstrip("+~")
        group = name.split(".", 1)[0]
        if name == "hydra.run.dir":
            raise UserError(f"`resume` names the run folder already; leave out {word!r}.")
        if group in ("resume", "hydra"):
            continue
        if group not in MAY_CHANGE and name not in MAY_CHANGE:
            raise UserError(
                f"`resume` continues a run with its own settings; only {', '.join(MAY_CHANGE)} "
                f"may be given with it, got {word!r}."
            )
        OmegaConf.update(config, name, OmegaConf.select(composed, name), merge=False)
    config.resume = str(folder)
    return config


def write_config(folder: Path, config: DictConfig) -> None:
    """Write the configuration of a run, as it was composed."""
    kept = OmegaConf.merge(config, {"resume": None})
    write_whole(folder / "config.yaml", OmegaConf.to_yaml(kept))


def write_versions(folder: Path) -> None:
    """Write the versions of what a run depends on, and the commit of its code."""
    system = f"{platform.system()} {platform.machine()}"
    versions = {"python": platform.python_version(), "platform": system}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed as a package"
    versions["git_commit"] = _git("rev-parse", "HEAD") or "unknown"
    versions["git_uncommitted_changes"] = str(bool(_git("status", "--porcelain")))
    write_whole(folder / "versions.json", json.dumps(versions, indent=2) + "\n")


def read_versions(folder: Path) -> dict[str, str]:
    """Read what :func:`write_versions` wrote; nothing if a run was killed before."""
    path = folder / "versions.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _git(*arguments: str) -> str:
    """Return what git says about this checkout, or nothing."""
    command = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent), *arguments]
    try:
        return subprocess.check_output(command, stderr=subprocess.DEVNULL, text=True).strip()
    except (OSError, subprocess.SubprocessError):
        return ""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make a folder and keep every other run out of it until the end."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("w")
    except OSError as error:
        raise UserError(f"`{folder}` can't be a run folder: {error.strerror}.") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UserError(f"`{folder}` is in use by a run that has not ended.") from error
        try:
            for stale in (*folder.glob(".*.tmp*"), *folder.glob("checkpoints/.*.tmp*")):
                stale.unlink()  # of a writer that was killed
            yield
        except OSError as error:
            where = error.filename or folder
            raise UserError(
                f"`{where}` can't be written or read: {error.strerror or error}."
            ) from error
        finally:
            if [path.name for path in folder.iterdir()] == [".lock"]:  # refused: leave nothing
                (folder / ".lock").unlink()


def make_logger(
    *, logger_type: str, logger_name: str, experiment_name: str, **kwargs: Any
) -> Logger:
    """Make a logger of TorchRL's, see conf/logger; name the package that is not installed."""
    if logger_type != "csv" and importlib.util.find_spec(logger_type) is None:
        raise UserError(
            f"`logger={logger_type}` needs {logger_type}, which is not installed: "
            f"pip install {logger_type}."
        )
    if logger_type != "mlflow":
        return get_logger(logger_type, logger_name, experiment_name, **kwargs)
    # get_logger would give a folder of files, which MLflow gave up.
    uri = kwargs["tracking_uri"] or f"sqlite:///{Path(logger_name, 'mlflow.db').absolute()}"
    return MLFlowLogger(exp_name=experiment_name, tracking_uri=uri)


def metric_columns(more: Iterable[str]) -> list[str]:
    """Return the columns of metrics.csv, frames first, those of the belief, times last."""
    return [*_METRICS, *more, "steps_per_second", "wall_time"]


class RunLog:
    """Tables and logger of a run; ``frames`` at which it goes on, None where it starts."""

    def __init__(
        self,
        folder: Path,
        config: DictConfig,
        columns: Iterable[str],
        frames: int | None,
        evaluated_frames: int | None,
    ) -> None:
        self.logger = build("logger", config.logger, logger_name=str(folder))
        self.metrics = Table(folder / "metrics.csv", metric_columns(columns), frames)
        self.episodes = Table(folder / "episodes.csv", ("frames", "return", "length"), frames)
        # Evaluations that the checkpoint does not know of are made again, the final one included.
        self.evaluations = Table(folder / "evaluation.csv", EVALUATION_COLUMNS, evaluated_frames)

    def rollout(self, row: Mapping[str, Any], finished: Sequence[Mapping[str, Any]]) -> None:
        """Log a rollout: its numbers by column, and a row for each episode that ended in it."""
        self.metrics.append([row])
        self.episodes.append(finished)
        self._scalars("train", row)

    def evaluation(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Log an evaluation."""
        self.evaluations.append(rows)
        for row in rows:
            self._scalars(f"evaluation_{row['mode']}", row)

    def _scalars(self, prefix: str, row: Mapping[str, Any]) -> None:
        for key, value in row.items():
            if isinstance(value, (int, float)) and key != "frames":
                self.logger.log_scalar(f"{prefix}/{key}", value, step=row["frames"])
