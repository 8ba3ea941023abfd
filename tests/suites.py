"""Requirements of losses and beliefs; those of transforms: `test_transforms_requirements.py`.

A test file subclasses a suite, fills in its hooks and inherits its tests.
"""

from suite_beliefs import BeliefModuleSuite
from suite_environments import (
    ACTION,
    OBS,
    AgentsEnv,
    StaircaseEnv,
    gym_env,
    parallel_env,
    saved,
    staircase,
    vectors,
)
from suite_losses import LossSuite
from suite_recipe_beliefs import RecipeBeliefSuite

__all__ = [
    "ACTION", "OBS", "AgentsEnv", "BeliefModuleSuite", "LossSuite", "RecipeBeliefSuite",
    "StaircaseEnv", "gym_env", "parallel_env", "saved", "staircase", "vectors",
]  # fmt: skip
