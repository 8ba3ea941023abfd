"""Requirements of losses and beliefs; those of transforms: `test_transforms_requirements.py`.

A test file subclasses a contract, fills in its hooks and inherits its tests.
"""

from contract_beliefs import BeliefModuleContract
from contract_environments import (
    ACTION,
    OBS,
    StaircaseEnv,
    gym_env,
    parallel_env,
    saved,
    staircase,
    vectors,
)
from contract_losses import LossContract
from contract_recipe_beliefs import RecipeBeliefContract

__all__ = [
    "ACTION", "OBS", "BeliefModuleContract", "LossContract", "RecipeBeliefContract", "StaircaseEnv",
    "gym_env", "parallel_env", "saved", "staircase", "vectors",
]  # fmt: skip
