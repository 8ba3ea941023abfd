"""Nodes for Hydra configurations of `torchrl.trainers`."""

import copy
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate
from omegaconf import OmegaConf

import torchrl_drbpn
from torchrl_drbpn import BeliefFilterModule, BeliefModelLoss, DRBPNLoss
from torchrl_drbpn.configs import register
from torchrl_drbpn.transforms import ObservationMissingness, PreviousAction

GUIDE = Path(__file__).parents[1] / "docs" / "guide"
SHORT = [
    "trainer.total_frames=256", "trainer.num_epochs=1", "collector.total_frames=256",
    "collector.frames_per_batch=128", "storage.max_size=128", "buffer.batch_size=64",
]  # fmt: skip
REQUIRED = {
    "observation_delay": {"delay": 1},
    "observation_multi_rate": {"period": [1, 2]},
    "observation_missingness": {"mechanism": "mcar", "eta": 0.5},
    "observation_noise": {"noise_std": [0.1, 0.2]},
    "observation_spikes": {"probability": 0.1, "spike_std": 5.0},
    "sensor_outages": {"eta": 0.5, "mean_length": 5},
    "sensor_reduction": {"missing": [0]},
    "stuck_sensors": {"probability": 0.1},
    "belief_filter": {"obs_dim": 2, "action_dim": 1},
    "gaussian_transition": {"state_dim": 2, "action_dim": 1},
    "linear_gaussian_emission": {"obs_dim": 2, "state_dim": 2, "action_dim": 1},
    "particle_filter": {"obs_dim": 2, "action_dim": 1},
}  # what a constructor requires


@pytest.fixture(scope="module", autouse=True)
def _own_store():
    """TorchRL's nodes have names of the recipe's groups: no other test may meet them."""
    store = ConfigStore.instance()
    before, store.repo = store.repo, copy.deepcopy(store.repo)
    importlib.import_module("torchrl.trainers.algorithms.configs")
    yield
    store.repo = before


def nodes():
    groups = {
        g: named for g, named in ConfigStore.instance().repo.items() if isinstance(named, dict)
    }
    return {
        (group, name.removesuffix(".yaml")): entry.node
        for group, named in groups.items()
        for name, entry in named.items()
        if not isinstance(entry, dict)
    }


def composed(*overrides):
    register()
    with initialize_config_dir(str(GUIDE), version_base="1.3"):
        return compose("trainer", [*SHORT, *overrides])


def test_a_trainer_of_torchrls_nodes_and_ours_trains(monkeypatch):
    monkeypatch.syspath_prepend(GUIDE)
    trainer = instantiate(composed("gaps.eta=0.5", "loss.model_coeff=0.3").trainer)
    loss = trainer.loss_module
    kinds = [type(transform) for transform in trainer.collector.env.transform]
    assert {PreviousAction, ObservationMissingness} <= set(kinds)
    assert isinstance(loss, DRBPNLoss)
    assert isinstance(loss.model_loss, BeliefModelLoss)
    assert isinstance(loss.filter_network, BeliefFilterModule)
    assert loss.model_coeff.item() == pytest.approx(0.3)
    mine = {id(parameter) for parameter in loss.parameters()}
    assert {id(parameter) for parameter in trainer.collector.policy.parameters()} <= mine
    before = {name: p.detach().clone() for name, p in loss.named_parameters()}
    trainer.train()
    for name, parameter in loss.named_parameters():
        assert parameter.isfinite().all(), name
        assert not torch.equal(parameter, before[name]), name


def test_registering_twice_is_harmless_and_takes_no_name_of_torchrls(monkeypatch):
    store = ConfigStore.instance()
    clean = {
        group: {name: entry for name, entry in named.items() if not name.startswith("drbpn_")}
        if isinstance(named, dict)
        else named
        for group, named in store.repo.items()
    }
    monkeypatch.setattr(store, "repo", clean)
    before = nodes()
    assert ("loss", "ppo") in before
    register()
    once = nodes()
    assert {key: once[key] for key in before} == before
    assert all(name.startswith("drbpn_") for _, name in once.keys() - before.keys())
    register()
    assert nodes() == once


def test_nothing_is_registered_and_hydra_not_imported_before_it_is_asked_for():
    code = "import sys, torchrl_drbpn.configs; print('hydra' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


@pytest.mark.parametrize("group", ["transform", "network"])
def test_every_node_builds_its_class_from_lists(group):
    register()
    ours = {n: node for (g, n), node in nodes().items() if g == group and n.startswith("drbpn_")}
    if group == "transform":
        assert len(ours) == len(torchrl_drbpn.transforms.__all__) - 1  # without seed_env
    for name, node in ours.items():
        short = name.removeprefix("drbpn_")
        values = REQUIRED.get(short, {})
        keys = {"in_keys": [["robot", "obs"]]} if "in_keys" in node else {}
        built = instantiate(OmegaConf.merge(node, values, keys))
        assert type(built).__name__.lower() == short.replace("_", "")
        if keys:
            assert next(iter(built.in_keys)) == ("robot", "obs")
