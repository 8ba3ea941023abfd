"""The moving average meets the requirements of every belief module of a recipe."""

from moving_average import build
from suites import ACTION, OBS, RecipeBeliefSuite


class TestMovingAverage(RecipeBeliefSuite):
    """Inherit the tests; say how the belief is made."""

    def make_belief(self, obs: int = OBS, action: int = ACTION):
        """Return a belief, equal to every other made with the same arguments."""
        return build(obs_dim=obs, action_dim=action, init_decay=0.7, prior=0.1)
