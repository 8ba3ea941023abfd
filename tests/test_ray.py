"""`collector=ray`: one run whose simulators and policies are in workers on two nodes."""

import pytest
import torch
from ppo_drbpn import train_rollout
from recipe_tools import assembled, refused, resume, run
from training.checkpoint import checkpoint_frames
from training.errors import EnvironmentFault

RAY = ("experiment=smoke", "collector=ray", "evaluation.every_frames=0")


@pytest.mark.slow
def test_an_address_that_does_not_answer_is_one_line():
    with refused(r"127.0.0.1:1`: no Ray cluster answers there"):
        assembled(*RAY, "collector.address=127.0.0.1:1")


@pytest.fixture
def cluster():
    """A Ray cluster of two nodes with a processor each."""
    import ray
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    made.add_node(num_cpus=1)
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.mark.slow
def test_a_run_on_two_nodes_learns_and_a_dead_worker_ends_it_saved(cluster, tmp_path):
    """A worker fills a node; its policy is the learner's; a run goes on with new workers."""
    import ray

    here = f"collector.address={cluster.address}"
    with refused("must be at most the 2 processors of the cluster, got 4"):
        assembled(*RAY, here, "collector.workers=4")
    training, config = assembled(*RAY, here)
    for _ in range(2):
        row, _ = train_rollout(training, config)
    assert row["frames"] == 256
    # The weights are sent before a rollout, so these are as old as the last update of the norm.
    first, second = training.collector.rollout()["observation"].chunk(2)
    assert (first != second).any(-1).all()  # each worker has episodes of its own
    workers = training.collector._collector
    wanted = training.agent.policy.state_dict()
    statistics = {value.data_ptr() for value in training.agent.norm.state_dict().values()}
    assert statistics <= {value.data_ptr() for value in wanted.values()}
    for state in workers.state_dict():
        remote = state["policy_state_dict"]
        assert remote.keys() == wanted.keys()
        assert all(torch.equal(remote[name], value) for name, value in wanted.items())
    assert not training.keeps_simulators
    ray.kill(workers.remote_collectors[1])
    with pytest.raises(EnvironmentFault, match=r"a worker of `collector=ray` died: .*pid: \d+"):
        train_rollout(training, config)
    # A whole run, and one that goes on with new workers.
    assert run(tmp_path / "run", *RAY, here, "total_frames=128") == 0
    assert resume(tmp_path / "run", "total_frames=256") == 0
    assert checkpoint_frames(tmp_path / "run") == 256
