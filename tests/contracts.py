"""Duties that every transform, loss and belief module of the package must meet.

A test file subclasses a contract, fills in its hooks and inherits its tests. The classes here are
not collected by themselves: their names do not begin with "Test".

`TransformContract` is TorchRL's own list for a transform test (single, serial-trans,
parallel-trans, trans-serial, trans-parallel, no env, compose, env, model, replay buffer, inverse),
and on top: any leading batch shape, float64 kept, the first observation of an episode treated like
every other, partial resets that leave the other rows alone, the global generator untouched, a
state that survives `torch.save` with `weights_only=True`, copies without a parent.

`LossContract` is TorchRL's list for a loss: keys, dispatch, reduction, parameters held once, files,
copies, dtypes and devices.

`BeliefModuleContract` is what `GRUModule` does in a TorchRL pipeline (one step or whole sequences,
primer, collector, batched environments, compile, export), and this package's rule for what a
recurrent module starts from: the beginning where `is_init & (age == 0)`, else the stored state.

`RecipeBeliefContract` is what the recipe needs of any belief module, with or without memory, with
or without a model.
"""

from __future__ import annotations

from contract_beliefs import (
    BeliefModuleContract,
    actions_in_float64,
    belief_env,
    with_belief_entries,
)
from contract_environments import (
    ACTION,
    OBS,
    StaircaseEnv,
    gym_env,
    parallel_env,
    saved,
    with_transform,
)
from contract_losses import LossContract
from contract_recipe_beliefs import RecipeBeliefContract
from contract_transforms import TransformContract

__all__ = [
    "ACTION",
    "OBS",
    "BeliefModuleContract",
    "LossContract",
    "RecipeBeliefContract",
    "StaircaseEnv",
    "TransformContract",
    "actions_in_float64",
    "belief_env",
    "gym_env",
    "parallel_env",
    "saved",
    "with_belief_entries",
    "with_transform",
]
