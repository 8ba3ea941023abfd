"""Save an agent to look at: ``python recipes/save_agent.py run=<run folder> out=agents/walker2d``.

The folder holds the configuration, the weights of the last checkpoint (safetensors, the statistics
of its normalisation among them), the final evaluation, and a card that says how it was trained and
what it returns. ``play.py``, ``evaluate.py`` and ``diagnose.py`` read it as they read a run.
"""

import json
import shlex
from pathlib import Path
from typing import Any

import pandas as pd
from evaluation.folders import override
from evaluation.trained import TrainedAgent, load_trained_agent, save_weights
from training.config import command
from training.console import log_line
from training.errors import UserError
from training.run_folder import load_config, read_versions, write_config, write_whole

_SHOWN = ["mode", "episodes", "return_mean", "return_std", "length_mean", "missing_ratio"]


def run(config: dict[str, Any]) -> int:
    """Save the agent of a run; see conf/save_agent.yaml."""
    for name in ("run", "out"):
        if config[name] is None:
            raise UserError(f"`{name}` must name a folder: run=<run folder> out=agents/walker2d.")
    folder, out = Path(config["run"]), Path(config["out"])
    if out.exists() and (not out.is_dir() or any(out.glob("checkpoints"))):
        raise UserError(f"`out` must be a folder for an agent, {out} is a file or a run folder.")
    trained = load_trained_agent(folder)
    table, versions = _final_evaluation(folder), read_versions(folder)
    out.mkdir(parents=True, exist_ok=True)
    write_config(out, load_config(folder))
    write_whole(out / "versions.json", json.dumps(versions, indent=2) + "\n")
    write_whole(out / "evaluation.csv", table.to_csv(index=False, lineterminator="\n"))
    write_whole(out / "README.md", _card(trained, table, versions, out))
    save_weights(out, trained)
    log_line(f"written: {out}")
    return 0


def _final_evaluation(folder: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(folder / "evaluation.csv")
        table = table[table["kind"] == "final"]
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"`{folder}` must hold evaluation.csv of a finished run.") from error
    if table.empty:
        raise UserError(f"`{folder}` has no final evaluation yet: its run has not ended.")
    return table


def _card(trained: TrainedAgent, table: pd.DataFrame, versions: dict[str, str], out: Path) -> str:
    own = trained.columns()
    commit = versions.get("git_commit", "unknown")
    if versions.get("git_uncommitted_changes") == "True":
        commit += ", with uncommitted changes"
    packages = ("torchrl_drbpn", "torch", "torchrl", "gymnasium", "mujoco")
    rows = {
        "task": own["task"],
        "method": own["method"],
        "missing in training": own["trained_on"],
        "noise in training, sigma": f"{own['noise_sigma']:g}",
        "environment steps": f"{own['frames']:,}",
        "seed": own["training_seed"],
        "commit": commit,
        "versions": ", ".join(f"{name} {versions.get(name, 'unknown')}" for name in packages),
    }
    shown = table[_SHOWN].to_markdown(index=False, floatfmt=".6g")
    return "\n".join(
        [
            f"# {own['task']}, {own['method']}",
            *("", "```bash", f"python recipes/play.py {override('run', out)}", "```", ""),
            *("| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())),
            "",
            "Every setting stands in [config.yaml](config.yaml). This trains the same:",
            *("", "```bash"),
            "python recipes/ppo_drbpn.py --config-name config --config-path "
            + shlex.quote(str(out.absolute()) if out.is_absolute() else f"../{out}"),
            *("```", ""),
            "Final evaluation under what it was trained with, raw returns:",
            *("", shown, ""),
        ]
    )


if __name__ == "__main__":
    command("save_agent", run)
