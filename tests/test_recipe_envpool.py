"""The training recipe over EnvPool, whose simulators keep their state to themselves."""

import shutil

import pytest
from ppo_drbpn import train_rollout
from recipe_tools import assembled, differences, read_table, resume, run
from training.checkpoint import last_checkpoint, load_checkpoint

SMOKE = (
    "experiment=smoke",
    "env.backend=envpool",
    "missingness=mcar",
    "missingness.eta=0.2",
    "evaluation.every_frames=0",
)
LINE = "InvertedPendulum-v5 can't save its state here: going on with new episodes"


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """Run the first half of the smoke experiment once."""
    folder = tmp_path_factory.mktemp("run") / "half"
    assert run(folder, *SMOKE, "total_frames=256") == 0
    return folder


def test_one_seed_gives_one_result_whatever_the_threads(half, tmp_path):
    run(tmp_path / "again", *SMOKE, "total_frames=256", "env.num_threads=2")
    for table in ("metrics.csv", "episodes.csv", "evaluation.csv"):
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
    training, config = assembled(*SMOKE)
    start = training.collector._carrier["observation"].clone()
    train_rollout(training, config)
    state = training.state_dict()
    assert state["simulators"] is None
    fresh, _ = assembled(*SMOKE)
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
