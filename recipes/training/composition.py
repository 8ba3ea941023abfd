"""The training configuration that a command line gives, composed without running it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

_CONF = Path(__file__).parents[2] / "conf"


def composed_config(overrides: Sequence[str]) -> dict[str, Any]:
    """Compose the configuration of ``recipes/ppo_drbpn.py``, inside a Hydra job or outside one.

    Args:
        overrides: words of the command line.

    Returns:
        The configuration, resolved, as plain containers.

    Raises:
        HydraException: if conf/ has no such group or key.
    """
    OmegaConf.register_new_resolver("run_folder", lambda resume, new: resume or new, replace=True)
    if GlobalHydra.instance().is_initialized():
        composed = compose("config", list(overrides))
    else:
        with initialize_config_dir(str(_CONF), version_base="1.3"):
            composed = compose("config", list(overrides))
    plain = OmegaConf.to_container(composed, resolve=True)
    if not isinstance(plain, Mapping):
        raise TypeError(f"conf/config.yaml must be a mapping, got {type(plain).__name__}")
    return {str(key): value for key, value in plain.items()}
