"""`DRBPNLoss` in TorchRL's own pipelines."""

import importlib
from pathlib import Path

import pytest
import small_agents
import torch
from small_agents import ACTION, ENVS, OBS, TIME, collect, make_agent, make_filter
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SliceSampler, SliceSamplerWithoutReplacement
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_drbpn import BeliefFilterModule, BeliefModelLoss, DRBPNLoss

FRAMES, SLICE = ENVS * TIME, 3
TRAJECTORY = ("collector", "traj_ids")


def make_loss(**kwargs):
    belief = BeliefFilterModule(make_filter(OBS, ACTION, torch.float64))
    agent = make_agent(belief, belief.feature_dim)
    ppo = ClipPPOLoss(agent.actor, agent.critic, log_explained_variance=False)
    return DRBPNLoss(belief, ppo, BeliefModelLoss(**kwargs))


def fresh(loss):
    """A rollout of the loss's own policy, with advantages."""
    belief, heads = loss.filter_network, loss.ppo_loss
    agent = make_agent(belief, belief.feature_dim)
    agent.actor, agent.critic = heads.actor_network, heads.critic_network
    return small_agents.add_advantages(agent, collect(agent))


def sliced(data, length=SLICE, slices=40):
    """Slices as TorchRL's sampler draws and marks them by default, one after the other."""
    sampler = SliceSampler(slice_len=length, traj_key=TRAJECTORY)
    storage = LazyTensorStorage(data.numel())
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=slices * length)
    buffer.extend(data.reshape(-1))
    return buffer.sample()


@pytest.mark.parametrize("own_gae", [False, True], ids=["gae of the trainer", "own gae"])
def test_it_trains_inside_ppotrainer(own_gae):
    loss = make_loss()
    before = {name: p.detach().clone() for name, p in loss.named_parameters()}
    options = {"frames_per_batch": FRAMES, "auto_register_policy_transforms": True}
    env = small_agents.make_env()
    collector = Collector(env, loss.actor_network, total_frames=4 * FRAMES, **options)
    sampler = SliceSamplerWithoutReplacement(slice_len=SLICE, traj_key=TRAJECTORY)
    storage = LazyTensorStorage(FRAMES)
    buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=8 * SLICE)
    if own_gae:
        loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    seen = []
    trainer = PPOTrainer(
        collector=collector, total_frames=4 * FRAMES, frame_skip=1, optim_steps_per_batch=1,
        loss_module=loss, optimizer=torch.optim.Adam(loss.parameters(), lr=3e-3), num_epochs=2,
        replay_buffer=buffer, progress_bar=False, gae=loss.value_estimator if own_gae else None,
    )  # fmt: skip
    trainer.register_op("post_loss", lambda batch: seen.append(batch.clone()) or batch)
    trainer.train()
    assert len(seen) >= 4
    assert all(batch.isfinite().all() for batch in seen[-1].select("advantage").values())
    for name, parameter in loss.named_parameters():
        assert parameter.isfinite().all(), name
        assert not torch.equal(parameter, before[name]), name


def test_the_estimator_of_the_loss_is_gae_over_whole_sequences():
    loss = make_loss()
    data = fresh(loss).exclude("advantage", "value_target", "state_value", ("next", "state_value"))
    gae = GAE(gamma=0.9, lmbda=0.8, value_network=loss.critic_network, deactivate_vmap=True)
    with set_recurrent_mode(True):
        expected = gae(data.clone())["advantage"]
    loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    for params in (None, loss.critic_network_params.detach()):
        received = loss.value_estimator(data.clone(), params=params)["advantage"]
        torch.testing.assert_close(received, expected)


def test_keys_set_on_the_held_loss_reach_an_estimator_that_is_there():
    loss = make_loss()
    loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    loss.ppo_loss.set_keys(reward="scaled_reward", advantage="adv")
    data = fresh(loss).exclude("advantage", "value_target", "state_value", ("next", "state_value"))
    expected = loss.value_estimator(
        data.copy().rename_key_(("next", "reward"), ("next", "scaled_reward"))
    )
    loss.ppo_loss.set_keys(reward="reward", advantage="advantage")
    torch.testing.assert_close(expected["adv"], loss.value_estimator(data.copy())["advantage"])


def test_networks_are_whole_and_their_parameters_are_the_losss():
    loss, data = make_loss(), fresh(make_loss())
    policy, critic = loss.actor_network, loss.critic_network
    torch.testing.assert_close(critic(data.clone())["state_value"], data["state_value"])
    assert set(policy.in_keys) >= set(loss.filter_network.in_keys)
    mine = {id(p) for p in loss.parameters()}
    for network, params in (
        (policy, loss.actor_network_params),
        (critic, loss.critic_network_params),
    ):
        assert {id(p) for p in params.parameters()} == {id(p) for p in network.parameters()} <= mine


def test_where_a_slice_is_cut_the_next_observation_does_not_count():
    loss = make_loss(reduction="none")
    data = fresh(loss)
    stored = data["next", "terminated"].flatten().clone()
    batch = sliced(data)
    assert batch["next", "done"].reshape(-1, SLICE)[:, -1].all()  # the sampler's mark
    ends = loss.model_loss.last_steps(batch)
    assert torch.equal(ends, stored[batch["index"].flatten()])
    assert ends.any()
    assert not ends.all()
    # what is not an end has the likelihood of its own observation
    honest = batch.clone()
    honest["next", "done"] = honest["next", "terminated"].clone()
    out = loss(batch)
    torch.testing.assert_close(out["loss_model"], loss(honest)["loss_model"])
    # and slices of fresh data have a ratio of one
    torch.testing.assert_close(out["ESS"], torch.ones_like(out["ESS"]), rtol=1e-9, atol=0)
    assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)


def test_ends_marked_as_final_before_they_are_stored_count_in_slices_too():
    loss = make_loss()
    data = fresh(loss)
    data["final"] = data["next", "done"].clone()
    data["final"][:, -1] = True
    assert data["next", "truncated"][:, :-1].any()
    batch = sliced(data)
    stored = data["final"].flatten()[batch["index"].flatten()]
    assert torch.equal(loss.model_loss.last_steps(batch), stored)


def test_an_epoch_of_the_guides_trainer_takes_every_step_once_from_a_ratio_of_one(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "docs" / "guide")
    guide = importlib.import_module("trainer_example")
    monkeypatch.setattr(guide, "TOTAL_FRAMES", 2 * guide.NUM_ENVS * guide.STEPS)
    trainer = guide.make_trainer()
    assert trainer.num_epochs == guide.EPOCHS
    trainer.num_epochs = 2
    epochs = []
    losses = trainer.loss_module.forward
    out = []
    monkeypatch.setattr(
        trainer.loss_module, "forward", lambda batch: out.append(losses(batch)) or out[-1]
    )
    trainer.register_op("pre_epoch", lambda batch: epochs.append([]) or batch)
    trainer.register_op("process_optim_batch", lambda b: epochs[-1].append(b["index"]) or b)
    trainer.train()
    steps = torch.arange(guide.NUM_ENVS * guide.STEPS)
    assert len(epochs) == 4
    for epoch in epochs:
        assert len(epoch) == guide.MINIBATCHES
        assert torch.equal(torch.cat(epoch).flatten().sort().values, steps)
    for first in out[:: 2 * guide.MINIBATCHES]:  # before the parameters of the rollout change
        torch.testing.assert_close(first["ESS"], torch.ones_like(first["ESS"]))
        assert first["max_ratio"].item() == pytest.approx(1, abs=1e-5)
