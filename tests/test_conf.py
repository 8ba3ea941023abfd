"""The configuration: every choice composes, every default is explained, bad values are refused.

No value is left to the code: settings are read with all their keys or not at all. What a person
gets wrong is answered with one line that names the setting.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
sys.path.insert(0, str(ROOT / "recipes"))

from beliefs import build_belief  # noqa: E402
from hydra import compose, initialize_config_dir  # noqa: E402
from omegaconf import OmegaConf  # noqa: E402
from training.config import EnvSettings, read_settings  # noqa: E402
from training.envs import task_dims  # noqa: E402
from training.errors import UserError  # noqa: E402
from training.resume import resumed_config  # noqa: E402
from training.run_folder import write_config  # noqa: E402

CHOICES = sorted(
    (path.parent.name, path.stem)
    for path in CONF.glob("*/*.yaml")
    if path.parent.name != "study"  # of another job: tests/test_study.py
)


@pytest.fixture(scope="module", autouse=True)
def _conf() -> Iterator[None]:
    OmegaConf.register_new_resolver("run_folder", lambda resume, new: resume or new, replace=True)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def config(*overrides: str) -> dict[str, Any]:
    """Compose the configuration that a command line gives."""
    composed = OmegaConf.to_container(compose("config", list(overrides)), resolve=True)
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


@pytest.mark.parametrize(("group", "choice"), CHOICES, ids=lambda value: value)
def test_every_choice_of_every_group_composes_into_settings(group: str, choice: str) -> None:
    settings = read_settings(config(f"{group}={choice}"))
    assert settings.collector.frames % settings.optim.sequence_length == 0


def test_overlays_can_be_combined() -> None:
    settings = read_settings(config("experiment=[paper,clean]", "env=hopper"))
    assert settings.env.env_id == "Hopper-v4"
    assert (settings.missingness.mechanism, settings.noise.sigma) == ("none", 0.0)
    assert (settings.optim.minibatches, settings.loss.normalize) == (32, "step")


def test_the_evaluation_configuration_composes() -> None:
    assert compose("evaluate", ["run=somewhere"]).episodes == 30


def _choices(path: Path) -> list[str]:
    axes = OmegaConf.to_container(OmegaConf.load(path))["axes"]
    return [str(choice) for choices in axes.values() for choice in choices]


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: path.stem)
def test_every_default_is_explained_on_its_line_or_above(path: Path) -> None:
    structure = ("defaults:", "hydra:", "_target_:", "name:", "- ")
    if path.parent.name == "study":  # the names of an axis are the user's
        structure += tuple(f"{name}: [" for name in _choices(path))
    if path.parent.name == "experiment":  # an overlay says what it is for at its head
        assert "# " in path.read_text().splitlines()[1]
        return
    for line in path.read_text().split("\nhydra:")[0].splitlines():
        text = line.strip()
        if ":" in text and not text.startswith(("#", *structure)):
            assert "#" in text or text.endswith(":"), f"{path.name}: {text}"


def test_a_missing_and_an_unknown_key_are_named() -> None:
    wrong = config()
    del wrong["optim"]["lr"]
    wrong["optim"]["rate"] = 1.0
    with pytest.raises(UserError, match=r"`optim` must have the keys .*\['lr'\].*\['rate'\]"):
        read_settings(wrong)


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("missingness.eta=1.5", r"`missingness.eta` must lie in \[0, 1\], got 1.5"),
        ("missingness.eta=-0.1", r"`missingness.eta` must lie in \[0, 1\]"),
        ("missingness.eta=much", "`missingness.eta` must be a finite number, got 'much'"),
        ("missingness.eta=nan", r"`missingness.eta` must lie in \[0, 1\], got nan"),
        ("optim.lr=inf", "`optim.lr` must be a finite number, got inf"),
        ("missingness.mechanism=all", "`missingness.mechanism` must be one of none, mcar"),
        ("noise.sigma=-1", "`noise.sigma` must be 0 or more"),
        ("env.version=v9", "`env.version` must be one of v4, v5, got 'v9'"),
        ("env.backend=abacus", "`env.backend` must be one of gymnasium, envpool, got 'abacus'"),
        ("total_frames=0", "`total_frames` must be positive"),
        ("total_frames=1.5", "`total_frames` must be a whole number"),
        ("total_frames=inf", "`total_frames` must be a whole number, got inf"),
        ("total_frames=nan", "`total_frames` must be a whole number, got nan"),
        ("seed=-1", "`seed` must be 0 or more"),
        ("seed=9223372036854775808", r"`seed` must be under 2\*\*63"),
        ("optim.sequence_length=48", "`optim.sequence_length` must divide"),
        ("optim.minibatches=7", "`optim.minibatches` must divide the 128 sequences"),
        ("evaluation.modes=[best]", "`modes` must hold sampled and mean, got 'best'"),
        ("heads.critic_input=all", "`heads.critic_input` must be one of features, complete"),
        ("loss.normalize=year", "`loss.normalize` must be one of entry, step"),
        ("logger.backend=paper", "`logger.backend` must be one of csv, tensorboard"),
        ("loss.normalize_advantage=3", "must be true or false"),
    ],
)
def test_a_bad_value_is_refused_in_one_line(override: str, line: str) -> None:
    with pytest.raises(UserError, match=line) as error:
        read_settings(config(override))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["belief.state_dim=0"], "`state_dim` must be an int of at least 1, got 0"),
        (["belief.policy_input=guess"], "`policy_input` must be 'mean' or 'mean_cov'"),
        (["belief._target_=nowhere.build"], "`belief._target_` must name a builder"),
        (["belief.emission.min_std=1.0"], "`min_std` and `init_std` must satisfy"),
        (["+belief.colour=red"], "`belief=drbpn`: .*colour"),
    ],
)
def test_bad_belief_settings_are_refused_in_one_line(overrides: list[str], line: str) -> None:
    belief = read_settings(config(*overrides)).belief
    with pytest.raises(UserError, match=line) as error:
        build_belief(belief, obs_dim=5, action_dim=2, normalize="entry")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("env_id", "version", "line"),
    [
        ("Wlaker2d", "v5", "`env_id` must be a registered.*Walker2d-v5"),
        ("CartPole", "v1", "discrete actions are not supported"),
        ("FrozenLake", "v1", "must have a vector observation"),
    ],
    ids=["unknown", "discrete-action", "no-vector"],
)
def test_an_unsuitable_environment_is_refused_in_one_line(
    env_id: str, version: str, line: str
) -> None:
    with pytest.raises(UserError, match=line) as error:
        task_dims(EnvSettings("x", env_id, version, "gymnasium"))
    assert "\n" not in str(error.value)


def test_resume_takes_the_settings_of_its_folder_and_only_the_allowed_overrides(
    tmp_path: Path,
) -> None:
    write_config(tmp_path, config("env=hopper", "seed=7", "resume=null"))
    words = ["resume=x", "total_frames=4096", "evaluation.episodes=3", "logger=tensorboard"]
    settings = read_settings(resumed_config(config(*words), words, tmp_path))
    assert (settings.env.name, settings.seed) == ("hopper", 7)
    assert (settings.total_frames, settings.evaluation.episodes) == (4096, 3)
    assert settings.logger.backend == "tensorboard"
    assert settings.resume == str(tmp_path)


@pytest.mark.parametrize("word", ["seed=1", "env=hopper", "optim.lr=0.1", "missingness.eta=0.1"])
def test_resume_refuses_other_overrides(tmp_path: Path, word: str) -> None:
    write_config(tmp_path, config())
    with pytest.raises(UserError, match=f"only total_frames, logger, evaluation .*{word}"):
        resumed_config(config(word), ["resume=x", word], tmp_path)


def test_resume_refuses_a_second_run_folder(tmp_path: Path) -> None:
    write_config(tmp_path, config())
    word = "hydra.run.dir=elsewhere"
    with pytest.raises(UserError, match=f"`resume` names the run folder already; .*{word}"):
        resumed_config(config(), ["resume=x", word], tmp_path)
