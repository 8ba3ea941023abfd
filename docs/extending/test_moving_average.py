"""The moving average meets the duties of every belief module of a recipe."""

from contracts import ACTION, OBS, RecipeBeliefContract
from moving_average import build


class TestMovingAverage(RecipeBeliefContract):
    """Inherit the tests; say how the belief is made."""

    def make_belief(self, obs: int = OBS, action: int = ACTION):
        """Return a belief, equal to every other made with the same arguments."""
        return build(obs_dim=obs, action_dim=action, init_decay=0.7, prior=0.1)
