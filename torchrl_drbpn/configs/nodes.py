"""One node of Hydra's ConfigStore for each class, its fields read from the constructor."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import field, make_dataclass
from typing import Any, get_args, get_type_hints

from torchrl_drbpn import modules, objectives, transforms

__all__ = ["make_ppo_trainer", "register"]

_NODES: dict[str, tuple[Any, ...]] = {
    "transform": (
        transforms.FillLastObserved,
        transforms.ObservationDelay,
        transforms.ObservationMissingness,
        transforms.ObservationMultiRate,
        transforms.ObservationNoise,
        transforms.ObservationSpikes,
        transforms.ObservedFromNaN,
        transforms.PreviousAction,
        transforms.SensorDrift,
        transforms.SensorOutages,
        transforms.SensorReduction,
        transforms.StuckSensors,
    ),
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
    "loss": (objectives.BeliefModelLoss, objectives.DRBPNLoss),
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
    fields: list[Any] = [
        (name, Any, field(default="???" if default is inspect.Parameter.empty else default))
        for name, default in _arguments(cls)
    ]
    # Hydra's own lists are lists then, as the constructors expect.
    fields += [
        ("_target_", str, field(default=f"{cls.__module__}.{cls.__qualname__}")),
        ("_convert_", str, field(default="all")),
    ]
    return make_dataclass(
        f"{cls.__name__}Config", fields, bases=(base,), namespace={"__post_init__": lambda _: None}
    )


def _arguments(cls: Any) -> Iterator[tuple[str, Any]]:
    """Yield each argument of a constructor and its default, those that it passes on included."""
    for name, parameter in list(inspect.signature(cls.__init__).parameters.items())[1:]:
        if parameter.kind is not parameter.VAR_KEYWORD:
            yield name, parameter.default
            continue
        for passed_on in get_args(get_type_hints(cls.__init__)[name]):
            yield from ((key, _default(cls, key)) for key in get_type_hints(passed_on))


def _default(cls: Any, argument: str) -> Any:
    """Return the default of an argument that a constructor passes on to a parent."""
    for parent in cls.__mro__:
        if "__init__" in vars(parent):
            parameter = inspect.signature(parent.__init__).parameters.get(argument)
            if parameter is not None:
                return parameter.default
    raise TypeError(f"no parent of {cls.__name__} takes `{argument}`.")
