"""Requirements that every loss and belief module of the package must meet.

Those of transforms are in `test_transforms_requirements.py`.

A test file subclasses a contract, fills in its hooks and inherits its tests. The classes here are
not collected by themselves: their names do not begin with "Test".

`LossContract` is TorchRL's list for a loss: keys, dispatch, reduction, parameters held once, files,
copies, dtypes and devices.

`BeliefModuleContract` is what `GRUModule` does in a TorchRL pipeline (one step or whole sequences,
primer, collector, batched environments, compile, export), and this package's rule for what a
recurrent module starts from: the initial state where `is_init & (age == 0)`, else the stored one.

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

__all__ = [
    "ACTION",
    "OBS",
    "BeliefModuleContract",
    "LossContract",
    "RecipeBeliefContract",
    "StaircaseEnv",
    "actions_in_float64",
    "belief_env",
    "gym_env",
    "parallel_env",
    "saved",
    "with_belief_entries",
    "with_transform",
]
