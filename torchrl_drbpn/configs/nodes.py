"""One node of Hydra's ConfigStore for each class, its fields read from the constructor."""

import inspect
import re
from collections.abc import Callable
from dataclasses import field, make_dataclass
from typing import Any

from torchrl_drbpn import modules, objectives, transforms

_NODES: dict[str, tuple[Any, ...]] = {
    "transform": tuple(getattr(transforms, n) for n in transforms.__all__ if n != "seed_env"),
    "network": (
        modules.BeliefFilter,
        modules.GaussianTransition,
        modules.LinearGaussianEmission,
        modules.ParticleFilter,
    ),
    "model": (
        modules.BeliefFilterModule,
        modules.MaskedObservationNorm,
        modules.ParticleFilterModule,
    ),
    "loss": tuple(getattr(objectives, name) for name in objectives.__all__),
}


def register() -> None:
    """Add the nodes to Hydra's ConfigStore, to the groups of ``torchrl.trainers``.

    A class has the name ``drbpn_`` and its own in lower case: ``transform/drbpn_sensor_outages``,
    ``network/drbpn_belief_filter``, ``model/drbpn_belief_filter_module``, ``loss/drbpn_loss``. A
    node has a field for each argument of the constructor; inside a list of keys a list of strings
    is a nested key. ``trainer/drbpn_ppo`` is TorchRL's ``trainer/ppo`` with
    :func:`make_ppo_trainer`. Nothing is registered at import; a second call changes nothing.

    Raises:
        ImportError: without Hydra (``pip install hydra-core``).
    """
    from hydra.core.config_store import ConfigStore
    from torchrl.trainers.algorithms import configs

    bases = {
        "transform": configs.TransformConfig,
        "network": configs.ConfigBase,
        "model": configs.ConfigBase,
        "loss": configs.LossConfig,
    }
    store = ConfigStore.instance().store
    for group, classes in _NODES.items():
        for cls in classes:
            store(group=group, name=f"drbpn_{_snake(cls.__name__)}", node=_node(cls, bases[group]))
    target: Any = f"{make_ppo_trainer.__module__}.{make_ppo_trainer.__qualname__}"
    trainer = make_dataclass(
        "DRBPNTrainerConfig",
        [("_target_", str, field(default=target))],
        bases=(configs.PPOTrainerConfig,),
    )
    store(group="trainer", name="drbpn_ppo", node=trainer)


def make_ppo_trainer(*, loss_module: Any, collector: Callable[..., Any], **kwargs: Any) -> Any:
    """Build TorchRL's ``PPOTrainer`` with a collector that runs the policy of the loss.

    Hydra builds whatever is named twice two times, so that ``policy: ${policy}`` in the collector
    would be another policy than the one of the loss until its first update.

    Args:
        loss_module: a :class:`~torchrl_drbpn.DRBPNLoss`.
        collector: TorchRL's node with ``_partial_: true`` and no policy.
        kwargs: of TorchRL's node ``trainer/ppo``.

    Returns:
        The trainer.
    """
    from hydra.utils import get_method
    from torchrl.trainers.algorithms.configs import PPOTrainerConfig

    make = get_method(PPOTrainerConfig._target_)
    policy = loss_module.actor_network
    return make(loss_module=loss_module, collector=collector(policy=policy), **kwargs)


def _snake(name: str) -> str:
    """Return `BeliefFilter` as belief_filter, and `DRBPNLoss` as loss."""
    return re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", "_", name.removeprefix("DRBPN")).lower()


def _node(cls: Any, base: type) -> type:
    # Hydra's own lists are lists then, as the constructors expect.
    given = {"_target_": f"{cls.__module__}.{cls.__qualname__}", "_convert_": "all"}
    fields: list[Any] = [
        (name, Any, field(default="???" if default is inspect.Parameter.empty else default))
        for name, default in (_arguments(cls) | given).items()
    ]
    return make_dataclass(
        f"{cls.__name__}Config", fields, bases=(base,), namespace={"__post_init__": lambda _: None}
    )


def _arguments(cls: Any) -> dict[str, Any]:
    """Return a constructor's arguments and defaults, those that it passes on included."""
    found: dict[str, Any] = {}
    for parent in cls.__mro__:
        if "__init__" in vars(parent):
            own = list(inspect.signature(parent.__init__).parameters.values())[1:]
            found = {p.name: p.default for p in own if p.kind is not p.VAR_KEYWORD} | found
            if all(p.kind is not p.VAR_KEYWORD for p in own):
                break
    return found
