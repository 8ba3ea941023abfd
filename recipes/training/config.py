"""The configuration of a run: composed by Hydra, checked once, built part by part."""

import datetime
import difflib
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_drbpn import BeliefDivergedError
from training.errors import UserError

CONF = Path(__file__).parents[2] / "conf"
_USER_ERROR = 2
# What ends in one line; of a belief where a learned model runs open loop.
EXPECTED = (UserError, BeliefDivergedError, HydraException, OmegaConfBaseException)

# Least and greatest value of what no constructor checks.
_LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("seed", "evaluation.seed"), (0, 2**63 - 1)),
    **dict.fromkeys(("threads", "env.num_threads"), (1, 256)),
    **dict.fromkeys(("total_frames", "collector.num_envs", "collector.steps_per_env"), (1, inf)),
    **dict.fromkeys(("collector.workers", "collector.cpus_per_worker"), (1, inf)),
    **dict.fromkeys(("optim.epochs", "optim.minibatches", "optim.sequence_length"), (1, inf)),
    **dict.fromkeys(("checkpoint.every_frames", "checkpoint.keep"), (1, inf)),
    **dict.fromkeys(("evaluation.every_frames", "evaluation.episodes"), (0, inf)),
    **dict.fromkeys(("evaluation.final_episodes", "noise.sigma", "noise.scale"), (0, inf)),
    **dict.fromkeys(("advantage.gamma", "advantage.lmbda"), (0, 1)),
    **dict.fromkeys(("loss.critic_coeff", "loss.entropy_coeff", "loss.model_coeff"), (0, inf)),
    "optim.lr": (0, inf),
    **dict.fromkeys(("optim.max_grad_norm", "loss.clip_epsilon"), (1e-12, inf)),
}
# Whole numbers of the commands that have them.
_COMMON = {"seed": (0, 2**63 - 1), "reduction_seed": (0, inf), "threads": (1, 256)}


def composed_config(overrides: Sequence[str] = ()) -> DictConfig:
    """Compose and check the configuration that a command line gives, outside a Hydra job."""
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            return checked(hydra.compose("config", list(overrides)), overrides)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error)) from error


def require_cpp_compiler(setting: str, instead: str) -> None:
    """Refuse a setting for which torch would call a C++ compiler that is not there."""
    name = os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")
    if shutil.which(name) is None:
        raise UserError(
            f"`{setting}` needs a C++ compiler, `{name}` is not there: install it, name another by "
            f"the environment variable CXX, or take {instead}."
        )


def choice(group: str, name: str, **values: Any) -> DictConfig:
    """Return an entry of a config group, such as ``choice("missingness", "mcar", eta=0.5)``."""
    node = cast(DictConfig, OmegaConf.load(CONF / group / f"{name}.yaml"))
    for key, value in values.items():
        if key not in node:
            raise UserError(f"`{group}={name}` has no `{key}`.")
        node[key] = value
    return node


def build(name: str, node: Any, *args: Any, **kwargs: Any) -> Any:
    """Build what a node of the configuration names; what it refuses is one line for the user.

    ``name`` is for the error; the node's own ``name`` is a label and not handed to the target.
    """
    plain = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
    if not isinstance(plain, dict) or "_target_" not in plain:
        raise UserError(f"`{name}` must name what is built by `_target_`, got {plain!r}.")
    plain.pop("name", None)
    try:
        return hydra.utils.instantiate(plain, *args, _convert_="all", **kwargs)
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, UserError):
            raise cause from error
        raise UserError(f"`{name}`: {one_line(cause)}") from error


def checked(config: DictConfig, overrides: Sequence[str] = ()) -> DictConfig:
    """Check types against those of the defaults, limits, and what must go together."""
    groups = [word for word in overrides if (CONF / word.split("=")[0].lstrip("+~")).is_dir()]
    defaults = hydra.compose("config", groups)
    for key, value in leaves(config):
        _check_type(config, key, value, OmegaConf.select(defaults, key, default=value))
    check_limits({key: OmegaConf.select(config, key) for key in _LIMITS}, _LIMITS)
    _check_sizes(config)
    if OmegaConf.select(config, "missingness.always_observed") == 1 and config.missingness.eta > 0:
        raise UserError(
            "`missingness.always_observed` must be under 1, got 1.0: nothing could go missing. "
            "Take missingness=none."
        )
    check_mode("evaluation.modes", *config.evaluation.modes)
    return config


def check_limits(
    values: Mapping[str, Any], limits: Mapping[str, tuple[float, float]], *, whole: bool = False
) -> None:
    """Refuse what is no (whole) number in [least, most], by its key; null is not looked at."""
    for key, (least, most) in limits.items():
        value = values[key]
        number = type(value) is int or (type(value) is float and not whole)
        if value is not None and not (number and least <= value <= most):
            wanted = f"at least {least:g}" if most == inf else f"in [{least:g}, {most:g}]"
            raise UserError(f"`{key}` must be {wanted}, got {value!r}.")


def _check_sizes(config: DictConfig) -> None:
    """Check that a rollout can be cut into sequences and minibatches."""
    optim, collector = config.optim, config.collector
    if "minibatches" not in optim or "steps_per_env" not in collector:
        return  # somebody's own
    if collector.steps_per_env % optim.sequence_length:
        raise UserError(
            f"`optim.sequence_length` must divide `collector.steps_per_env`, "
            f"got {optim.sequence_length} and {collector.steps_per_env}."
        )
    sequences = collector.num_envs * collector.steps_per_env // optim.sequence_length
    if sequences % optim.minibatches:
        raise UserError(
            f"`optim.minibatches` must divide the {sequences} sequences of a rollout, "
            f"got {optim.minibatches}."
        )


def _check_type(config: DictConfig, key: str, value: Any, default: Any) -> None:
    """Hold a value to the type of its default, null for any; make whole floats integers."""
    if default is None or isinstance(default, DictConfig) or value is default:
        return
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, bool):
        right, wanted = isinstance(value, bool), "true or false"
    elif isinstance(default, int):
        right, wanted = number and float(value).is_integer(), "a whole number"
        if right:
            OmegaConf.update(config, key, int(value))
    elif isinstance(default, ListConfig):
        right, wanted = value is not None, f"a list such as {default}"
        if not isinstance(value, ListConfig):  # a bare number or word is a list of one
            OmegaConf.update(config, key, [value])
    elif isinstance(default, float):
        right, wanted = (number and abs(value) < inf) or default != default, "a finite number"
    else:
        right, wanted = isinstance(value, str), "text"
    if not right:
        raise UserError(f"`{key}` must be {wanted}, got {value!r}.")


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every entry that holds no others."""
    if isinstance(node, DictConfig):
        for key in node:
            if OmegaConf.is_interpolation(node, str(key)):
                continue  # checked where it comes from
            name = f"{path}.{key!s}" if path else str(key)
            if OmegaConf.is_missing(node, key):
                raise UserError(f"`{name}` must be given.")
            yield from leaves(node[key], name)
    else:
        yield path, node


def check_mode(key: str, *modes: Any) -> None:
    """Refuse kinds of action other than ``sampled`` and ``mean``, and an empty list of them."""
    for mode in modes or ([],):
        if mode not in ("sampled", "mean"):
            raise UserError(f"`{key}` must be sampled or mean, got {mode!r}.")


def _run_folder(resume: str | None, env: str, version: str | None, belief: str, seed: int) -> str:
    """Return the folder that ``resume`` names, or make one that nobody has."""
    return resume or new_folder(f"{env}{f'-{version}' if version else ''}-{belief}-seed{seed}")


def new_folder(name: str) -> str:
    """Make a folder in runs/ that nobody has; the time follows the name."""
    now = datetime.datetime.now().strftime("%Y-%m-%d-%H-%M-%S")
    for number in range(1, 10_000):
        path = Path("runs") / f"{name}-{now}{f'-{number}' if number > 1 else ''}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        return str(path)
    raise UserError(f"`runs/{name}-{now}` and what follows it are taken.")


OmegaConf.register_new_resolver("run_folder", _run_folder, use_cache=True, replace=True)


def run_command(main: Callable[[], None], name: str = "config") -> None:
    """Run a command of recipes/; leave with status 2 and one line where the user can mend it."""
    # Hydra hands errors on instead of printing them; where the user wants tracebacks, we do too.
    wanted = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if wanted:
        main()
    elif status := explained(main, name):
        sys.exit(status)


def command(name: str, run: Callable[[dict[str, Any]], int]) -> None:
    """Run a recipe on what Hydra composes from a file of conf/, as plain containers."""

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)
    def main(config: DictConfig) -> None:
        plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))

        def checked_run() -> int:
            limits = {key: limit for key, limit in _COMMON.items() if key in plain}
            check_limits(plain, limits, whole=True)
            return run(plain)

        # Explained in here: Hydra puts a line of its own before an error that leaves its job.
        if status := explained(checked_run, name):
            sys.exit(status)

    run_command(main, name)


def explained(job: Callable[[], int | None], name: str = "config") -> int:
    """Run a job; turn what the user can mend into one line on standard error, and status 2."""
    try:
        return job() or 0
    except EXPECTED as error:
        line = explain(error, name)
    except OSError as error:  # Hydra makes the run folder
        line = f"`{error.filename}` can't be used: {error.strerror or error}."
    sys.stderr.write(f"error: {line}\n")
    return _USER_ERROR


def explain(error: BaseException, file: str = "config") -> str:
    """Turn an error into one line; an unknown name gets the nearest one that conf/ has."""
    text = str(error)
    if found := re.search(
        r"Could not (?:override|append to config\. An item is .*?|delete.*?) ?'([^']+)'", text
    ):
        name = found[1]
        return f"`{name}` is no setting: {nearest(name, _names(file))}"
    if found := re.search(r"Could not find '([^']+)'", text):
        group, _, name = found[1].rpartition("/")
        options = re.findall(r"^\t(\S+)$", text, re.MULTILINE)
        return f"`{group}={name}` is no choice: {nearest(name, options)}"
    if found := re.search(r"[Mm]issing mandatory value: (\S+)", text):
        return f"`{found[1]}` must be given."
    return one_line(error)


def one_line(error: BaseException) -> str:
    """Return what an error says, in one line of at most 400 characters."""
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return (" ".join(text.split()) or type(error).__name__)[:400]


def nearest(name: str, names: Sequence[str]) -> str:
    """Return a hint: the nearest of some names, or all of them."""
    found = difflib.get_close_matches(name, names, 1, 0.5)
    return f"did you mean `{found[0]}`?" if found else f"there are {', '.join(sorted(names))}."


def _names(file: str) -> list[str]:
    """Return every dotted key of a configuration, of the training's every group too."""
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        keys = [key for key, _ in leaves(hydra.compose(file))]
    parents = {key[:i] for key in keys for i in range(len(key)) if key[i] == "."}
    groups = [path.name for path in CONF.iterdir() if path.is_dir() and file == "config"]
    return sorted({*keys, *parents, *groups})
