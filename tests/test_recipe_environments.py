"""The training recipe over TorchRL's environments, over EnvPool, and over workers of Ray."""

import shutil
from functools import partial

import pytest
import torch
from ppo_drbpn import train_rollout
from recipe_tools import SMOKE, TABLES, assembled, differences, read_table, refused, resume, run
from suite_environments import ACTION, OBS, StaircaseEnv
from torchrl.data import Binary, Bounded
from torchrl.envs import GymEnv
from training.checkpoint import checkpoint_frames, last_checkpoint, load_checkpoint
from training.envs import make_torchrl_env
from training.errors import EnvironmentFault


def made(make, num_envs=3, keys=("observation",)):
    return make_torchrl_env(
        id="mine", version=None, make=make, num_envs=num_envs, parallel=False, observation_keys=keys
    )


def test_an_action_beyond_its_limits_is_clipped_and_stored_as_it_was_sampled():
    rewards = []
    for action in (2.0, 5.0):
        env = made(partial(GymEnv, "Pendulum-v1"))
        env.set_seed(0)
        data = env.reset().set("action", torch.full((3, 1), action))
        rewards.append(env.step(data)["next", "reward"])
        assert (data["action"] == action).all()
    assert torch.equal(*rewards)


@pytest.mark.parametrize(
    ("make", "num_envs", "keys", "message"),
    [
        (partial(GymEnv, "CartPole-v1"), 3, ("observation",), "a vector of bounded real numbers"),
        (partial(GymEnv, "Nope-v1"), 3, ("observation",), "`Nope` doesn't exist"),
        (partial(GymEnv, "Pendulum-v1"), 3, ("position",), "hold entries .* observation; got pos"),
        (partial(StaircaseEnv, batch=5), 3, ("observation",), "set collector.num_envs=5, got 3"),
    ],
    ids=["discrete", "unknown", "keys", "batch"],
)
def test_what_can_not_be_trained_is_one_line(make, num_envs, keys, message):
    with refused(message):
        made(make, num_envs, keys)


@pytest.mark.parametrize("spread", [True, False])
def test_robots_that_never_fall_do_not_stay_in_step(spread):
    sizes = ("collector.num_envs=16", "collector.steps_per_env=128", "env=reacher")
    training, _ = assembled(*SMOKE, *sizes, f"collector.spread={str(spread).lower()}")
    for _ in range(2):  # a run starts twice: what it throws away spreads nothing
        done = training.collector.rollout()["next", "done"].squeeze(-1)
        ends = [row.nonzero().squeeze(-1) for row in done]
        firsts = torch.stack([row[0] + 1 for row in ends])
        assert len(firsts.unique()) > 8 if spread else (firsts == 50).all()
        assert all((row.diff() == 50).all() for row in ends)
        training.start_episodes()


class MaskingEnv(StaircaseEnv):
    """Component i arrives at the steps that i + 1 divides; elsewhere a number that is none."""

    def __init__(self, batch):
        super().__init__(batch, horizon=7)
        spec = self.observation_spec.clone()
        spec["mask"] = Binary(shape=(batch, OBS), dtype=torch.bool)
        self.observation_spec = spec
        self.action_spec = Bounded(-1.0, 1.0, shape=(batch, ACTION), dtype=torch.float32)

    def _observe(self):
        data = super()._observe()
        data["mask"] = self.time[:, None] % torch.arange(1, OBS + 1) == 0
        return data.set("observation", data["observation"].where(data["mask"], -9e3))


def test_an_environment_trains_and_resumes_by_its_target(tmp_path):
    make = ["env.make._target_=torchrl.envs.GymEnv", "+env.make.env_name=Pendulum-v1"]
    words = [*SMOKE, "env=torchrl", "env.id=pendulum", *make]
    run(tmp_path / "run", *words, "total_frames=128")
    resume(tmp_path / "run", "total_frames=256")
    (row, *_) = read_table(tmp_path / "run" / "metrics.csv")
    assert row["missing_ratio"]


@pytest.mark.parametrize("eta", [0.0, 0.5])
def test_the_mask_that_an_environment_writes_says_what_arrived(eta):
    words = (f"env.make._target_={__name__}.MaskingEnv", "+env.make.batch=4", "env.id=staircase")
    more = ("env=torchrl", "missingness=from_mask", f"missingness.eta={eta}", "noise=none")
    training, config = assembled("experiment=smoke", "collector.num_envs=4", *more, *words)
    row, _ = train_rollout(training, config)
    assert torch.tensor([v for v in row.values() if v is not None]).isfinite().all()
    data = training.collector.rollout()
    for frame, time in ((data, data["step_count"]), (data["next"], data["next", "step_count"])):
        arrived = time % torch.arange(1, OBS + 1) == 0
        assert frame["observed"].any()
        assert not (frame["observed"] & ~arrived).any()
        assert torch.equal(frame["observed"], arrived) is (eta == 0)
        assert not frame["observation"][~frame["observed"]].any()
    assert data["normalized_observation"].isfinite().all()
    assert row["missing_ratio"] > 0.4


ENVPOOL = (*SMOKE, "env.backend=envpool", "evaluation.every_frames=0")
LINE = "InvertedPendulum-v5 can't save its state here: going on with new episodes"


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "half"
    assert run(folder, *ENVPOOL, "total_frames=256") == 0
    return folder


def test_one_seed_gives_one_result_whatever_the_threads(half, tmp_path):
    run(tmp_path / "again", *ENVPOOL, "total_frames=256", "env.num_threads=2")
    for table in TABLES:
        assert read_table(half / table) == read_table(tmp_path / "again" / table), table


def test_a_resumed_run_says_in_one_line_that_it_goes_on_with_new_episodes(half, tmp_path, capsys):
    folders = [shutil.copytree(half, tmp_path / name) for name in "ab"]
    for folder in folders:
        assert resume(folder, "total_frames=512") == 0
        assert "".join(capsys.readouterr()).count(LINE) == 1
        rows = read_table(folder / "metrics.csv")
        assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512]
    first, second = (load_checkpoint(last_checkpoint(folder)) for folder in folders)
    assert differences(first, second) == []


def test_all_but_the_episodes_is_restored_and_the_first_ones_are_not_repeated():
    training, config = assembled(*ENVPOOL)
    start = training.collector._carrier["observation"].clone()
    train_rollout(training, config)
    state = training.state_dict()
    assert state["simulators"] is None
    fresh, _ = assembled(*ENVPOOL)
    fresh.load_state_dict(state, "here")
    again = fresh.state_dict()
    # New episodes draw from the generators of the corruption and of torch.
    for changed in ("torch_generator", "transforms"):
        state.pop(changed), again.pop(changed)
    for statistics in (state, again):  # and their discounted returns begin anew
        del statistics["reward_statistics"]["discounted"]
    assert differences(state, again) == []
    carrier = fresh.collector._carrier
    assert carrier["is_init"].all()
    assert not carrier["step_count"].any()
    assert not (carrier["observation"] == start).all(-1).any()


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
