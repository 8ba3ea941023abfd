"""Requirements of every belief module of a recipe; see suites.py."""

import pytest
import small_agents
import torch
from belief_frames import BeliefFrames
from suite_environments import ACTION, OBS, StaircaseEnv
from torchrl.envs import Compose, InitTracker, StepCounter, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss
from torchrl_drbpn.modules import MaskedObservationNorm
from torchrl_drbpn.transforms import ObservationMissingness, ObservationNoise, PreviousAction

LOG_LIKELIHOOD = ("belief", "log_likelihood")


class RecipeBeliefSuite(BeliefFrames):
    """Requirements of what a builder under recipes/beliefs returns."""

    observation = "normalized_observation"

    # --- hooks
    def make_belief(self, obs=OBS, action=ACTION):
        """Return a belief in float32, equal to every other made with the same arguments."""
        raise NotImplementedError(f"{type(self).__name__} must say in `make_belief` what is tested")

    # --- helpers
    def any_module(self):
        return self.make_belief().module

    def frames(self, time=6):
        """Return three rows that begin an episode; one of them begins another."""
        frames = self.make_frames((3, time))
        frames["is_init"][:, 0] = True
        frames["is_init"][1, time // 2] = True
        return frames

    def sequence(self, belief, frames):
        """Run over time from what a collector that saw the same frames would have stored."""
        with torch.no_grad():
            stored = self.one_by_one(belief.module, frames.detach(), None)
        states = stored.select(*self.state_keys(belief.module))
        return self.as_sequence(belief.module, frames.copy().update(states))

    def learned_belief(self):
        """Return a belief away from where it starts: some start with layers of zeros."""
        belief = self.make_belief()
        g = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for parameter in belief.module.parameters():
                parameter += 0.05 * torch.randn(parameter.shape, generator=g)
        return belief

    def make_env(self):
        """Return four rows dressed as the recipe does, two that terminate, one that is cut off."""
        gaps, steps = ObservationMissingness("mcar", 0.5, always_observed=0.0), StepCounter(5)
        chain = Compose(PreviousAction(), ObservationNoise(100.0), gaps, steps, InitTracker())
        return TransformedEnv(StaircaseEnv(4), chain)

    def collected(self, belief):
        """Return heads and a rollout whose rows begin in mid-episode, with ends of both kinds."""
        norm = MaskedObservationNorm(OBS)
        norm.update(self.make_env().rollout(40, break_when_any_done=False))
        options = {"dtype": torch.float32, "actions": ACTION, "norm": norm}
        agent = small_agents.make_agent(belief.module, belief.feature_dim, **options)
        data = small_agents.collect(agent, env=self.make_env())
        norm(data["next"])
        assert data.shape == (4, 18)
        assert not data["is_init"][:, 0].all()
        terminated, truncated = data["next", "terminated"], data["next", "truncated"]
        assert (terminated & ~truncated)[:, :-1].any()
        assert (truncated & ~terminated)[:, :-1].any()
        return agent, data

    # --- keys
    @pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
    def test_features_have_their_width_at_every_batch_shape(self, shape):
        belief = self.make_belief()
        step = self.make_frames(shape)
        for key, spec in self.primers(belief.module).items():
            step.set(key, spec.expand(*shape, *spec.shape).zero())
        out = belief.module(step)
        assert out["features"].shape == (*shape, belief.feature_dim)
        assert out["features"].dtype == torch.float32
        assert out["features"].isfinite().all()

    # --- steps and sequences
    def test_a_rollout_is_what_sequences_cut_from_it_give(self):
        belief = self.learned_belief()
        _, data = self.collected(belief)
        with torch.no_grad():
            self.assert_same(belief.module, self.as_sequence(belief.module, data), data)
            for start in (1, 7, 13):
                cut = self.as_sequence(belief.module, data[:, start:])
                self.assert_same(belief.module, cut, data[:, start:])

    def test_one_step_from_what_is_stored_gives_every_belief_that_follows(self):
        belief = self.learned_belief()
        _, data = self.collected(belief)
        module, stored = belief.module, data["features"]
        with torch.no_grad():
            following = module(data["next"].select(*module.in_keys).reshape(-1))
        following = following["features"].reshape_as(stored)
        limit = self.tolerance32 * max(1.0, stored.abs().max().item())
        goes_on = ~data["next", "done"][:, :-1, 0]
        torch.testing.assert_close(
            following[:, :-1][goes_on], stored[:, 1:][goes_on], rtol=self.tolerance32, atol=limit
        )

    # --- what arrived
    def test_features_follow_what_arrived(self):
        belief = self.make_belief()
        frames = self.frames()
        frames[self.observation].requires_grad_()
        out = self.sequence(belief, frames)["features"]
        (grad,) = torch.autograd.grad(out.square().sum(), frames[self.observation])
        assert grad.isfinite().all()
        assert (grad[frames["observed"]] != 0).float().mean() > 0.9

    def test_a_long_outage_leaves_it_finite(self):
        belief = self.make_belief()
        frames = self.make_frames((2, 60))
        frames["is_init"][:, 0] = True
        frames["observed"][:, 2:] = False
        frames[self.observation][:, 2:] = 0.0
        out = self.sequence(belief, frames)
        for key in self.written(belief.module):
            assert out[key].isfinite().all(), key
        if out["features"].requires_grad:
            out["features"].square().mean().backward()
            for name, parameter in belief.module.named_parameters():
                assert parameter.grad is None or parameter.grad.isfinite().all(), name

    # --- learning
    def test_fresh_data_give_a_ratio_of_one_and_every_parameter_a_gradient(self):
        belief = self.learned_belief()
        agent, data = self.collected(belief)
        with torch.no_grad():
            data["state_value"] = agent.critic.module(data["features"])
            following = belief.module(data["next"].select(*belief.module.in_keys).reshape(-1))
            value = agent.critic.module(following["features"])
            data["next", "state_value"] = value.reshape(*data.shape, 1)
            GAE(gamma=0.99, lmbda=0.95, value_network=None)(data)
        ppo = ClipPPOLoss(agent.actor, agent.critic, normalize_advantage=True)
        modelled = LOG_LIKELIHOOD in belief.module.out_keys
        loss = DRBPNLoss(belief.module, ppo, BeliefModelLoss() if modelled else None)
        assert "features" not in loss.in_keys
        data["final"] = torch.zeros(*data.shape, 1, dtype=torch.bool)
        data["final"][:, -1] = True
        # sequences of 6, each from the state that the collector stored at its first step
        out = loss(data.select(*loss.in_keys, strict=False).reshape(-1).reshape(-1, 6))
        assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)
        torch.testing.assert_close(out["ESS"], torch.ones_like(out["ESS"]), rtol=1e-4, atol=0)
        assert out["kl_approx"].item() == pytest.approx(0, abs=1e-4)
        assert ("loss_model" in out) == modelled
        total = sum(value for key, value in out.items() if key.startswith("loss"))
        assert isinstance(total, torch.Tensor)
        total.backward()
        for name, parameter in belief.module.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.any(), name

    def test_the_global_generator_is_untouched(self):
        belief = self.make_belief()
        state = torch.get_rng_state()
        self.one_by_one(belief.module, self.frames(2), None)
        self.sequence(belief, self.frames())
        belief.summary()
        assert torch.equal(torch.get_rng_state(), state)

    # --- what the recipe asks for besides
    def test_what_it_tells_of_the_sensors_comes_from_the_same_belief(self):
        import beliefs

        belief = self.make_belief()
        if belief.observing is None:
            return
        step = self.one_by_one(belief.module, self.frames(2), None)[:, 1]
        observing = belief.observing()
        out = observing(step.select(*belief.module.in_keys))
        for key in belief.module.out_keys:
            torch.testing.assert_close(out[key], step[key])
        weights = {id(parameter) for parameter in belief.module.parameters()}
        assert {id(parameter) for parameter in observing.parameters()} <= weights
        told = {beliefs.FORECAST_COV: (3, OBS, OBS)} | dict.fromkeys(
            (beliefs.ESTIMATE, beliefs.ESTIMATE_VARIANCE, beliefs.FORECAST, beliefs.NOISE_VARIANCE),
            (3, OBS),
        )
        written = [key for key in told if out.get(key, None) is not None]
        assert written
        for key in written:
            assert out[key].shape == told[key], key
            assert out[key].isfinite().all(), key
