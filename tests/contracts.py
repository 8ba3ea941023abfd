"""Requirements of losses and beliefs; those of transforms: `test_transforms_requirements.py`.

A test file subclasses a contract, fills in its hooks and inherits its tests. `LossContract` is
TorchRL's list for a loss. `BeliefModuleContract` is what `GRUModule` does in a pipeline, and
this package's rule for what a recurrent module starts from: the initial state where
`is_init & (age == 0)`, else the stored one. `RecipeBeliefContract` is what the recipe needs.
"""

from contract_beliefs import BeliefModuleContract
from contract_environments import (
    ACTION,
    OBS,
    StaircaseEnv,
    belief_env,
    gym_env,
    parallel_env,
    saved,
    staircase,
    vectors,
    with_belief_entries,
    with_transform,
)  # fmt: skip
from contract_losses import LossContract
from contract_recipe_beliefs import RecipeBeliefContract

__all__ = [
    "ACTION", "OBS", "BeliefModuleContract", "LossContract", "RecipeBeliefContract", "StaircaseEnv",
    "belief_env", "gym_env", "parallel_env", "saved", "staircase", "vectors",
    "with_belief_entries", "with_transform",
]  # fmt: skip
