"""A run folder that can't be used is answered with one line, and what is in it stays."""

import fcntl
import random
import resource
import shlex
import shutil
from pathlib import Path

import pytest
from recipe_tools import (
    SMOKE,
    assembled,
    assert_same_run,
    make_config,
    read_table,
    refused,
    resume,
    run,
)
from training.checkpoint import last_checkpoint, load_checkpoint
from training.errors import UserError
from training.run_folder import Table, read_config


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_second_run_into_a_folder_is_refused_and_the_first_one_stays(smoke):
    before = contents(smoke)
    with refused(r"holds a run already: .*resume="):
        run(smoke, *SMOKE, "seed=1")
    assert contents(smoke) == before


def test_the_command_that_a_refusal_prints_goes_on_with_that_folder(smoke, tmp_path):
    folder = shutil.copytree(smoke, tmp_path / "eta=0.5, [s 0]")
    with pytest.raises(UserError) as error:
        run(folder, *SMOKE)
    (word,) = shlex.split(str(error.value).removesuffix(".").split("or ")[-1])
    assert make_config(word).resume == str(folder)


def test_a_folder_of_a_run_without_a_checkpoint_is_refused_without_a_promise(folder):
    shutil.rmtree(folder / "checkpoints")
    with refused("ended before its first checkpoint: remove it, or name"):
        run(folder, *SMOKE)


def test_two_runs_in_one_folder_at_once_are_refused(folder):
    with (folder / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with refused("is in use by a run that has not ended"):
            resume(folder, "total_frames=768")
    assert len(read_table(folder / "metrics.csv")) == 4
    assert resume(folder, "total_frames=640") == 0


def test_a_file_where_a_folder_should_be_is_named(tmp_path):
    (tmp_path / "run").write_text("hello")
    with refused("can't be a run folder: "):
        run(tmp_path / "run" / "below", *SMOKE)


LAST = "checkpoints/frames_000000000512.pt"
TABLE = r"metrics.csv` can't be read.*damaged"
CHECKPOINT = r"512.pt` can't be read.* go on from `frames_.*256.pt`"


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("metrics.csv", b"\xff\xfe\x00", TABLE),
        ("metrics.csv", b"", TABLE),
        ("metrics.csv", b"fram\n1\n", "metrics.csv` lacks the columns frames"),
        ("metrics.csv", None, "metrics.csv` can't be read as a table: is it damaged"),
        ("config.yaml", b"\xff\xfe\x00", "config.yaml"),
        ("config.yaml", b"", "config.yaml"),
        ("config.yaml", None, "config.yaml"),
        ("checkpoints", b"no folder", "copy` holds no checkpoint"),
        (LAST, b"", CHECKPOINT),
        (LAST, b"PK\x03\x04 cut", CHECKPOINT),
        (LAST, None, "512.pt` must be a checkpoint"),
    ],
)
def test_what_is_damaged_is_named_and_stays_as_it_is(folder, name, content, line):
    """With content None a folder is where a file should be."""
    path = folder / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    path.mkdir() if content is None else path.write_bytes(content)
    before = contents(folder)
    with refused(line):
        resume(folder, "total_frames=640")
    assert contents(folder) == before


def test_a_flipped_bit_in_a_checkpoint_is_refused_and_the_one_before_is_named(folder):
    path = last_checkpoint(folder)
    whole, draw = path.read_bytes(), random.Random(0)
    for place in (82, *(draw.randrange(8 * len(whole)) for _ in range(100))):
        data = bytearray(whole)
        data[place // 8] ^= 1 << place % 8
        path.write_bytes(data)
        with refused(CHECKPOINT):
            load_checkpoint(path)
        assert path.read_bytes() == data


def test_a_bit_that_the_archive_does_not_watch_is_seen_by_the_sum_beside_it(folder):
    path = last_checkpoint(folder)
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 12] ^= 1  # a time of the archive's directory
    path.write_bytes(data)
    with refused(r"not as frames_.*\.sha256 says"):
        load_checkpoint(path)
    path.with_name(path.name + ".sha256").unlink()
    assert load_checkpoint(path)["progress"]["frames"] == 512


@pytest.mark.parametrize("share", [0.08, 0.9])
def test_a_full_disk_ends_in_one_line_and_the_last_checkpoint_stays(folder, smoke, share):
    """No file may grow beyond a share of what a checkpoint holds."""
    size = int(share * last_checkpoint(folder).stat().st_size)
    last_checkpoint(folder).unlink()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        with refused(r"can't be written: .*before it are kept"):
            resume(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert last_checkpoint(folder).name == "frames_000000000256.pt"
    assert not list(folder.rglob(".*.tmp*"))
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_what_a_killed_writer_left_is_removed_and_foreign_files_are_left_alone(folder, smoke):
    last_checkpoint(folder).unlink()
    stale = [".metrics.csv.7.tmp", "checkpoints/.frames_000000000384.pt.tmp"]
    foreign = folder / "checkpoints" / "frames_zzz.pt"
    for path in (*(folder / name for name in stale), foreign):
        path.write_text("half")
    with (folder / "metrics.csv").open("a") as table:
        table.write("9999,1.")
    assert resume(folder) == 0
    assert_same_run(smoke, folder)
    assert not list(folder.rglob(".*.tmp*"))
    assert foreign.read_text() == "half"


def test_a_table_drops_what_was_written_after_the_checkpoint(tmp_path):
    path = tmp_path / "t.csv"
    table = Table(path, ["frames", "value"])
    table.append([{"frames": 1, "value": None}, {"frames": 2, "value": 5, "more": 6}])
    Table(path, ["frames", "value", "new"], up_to_frames=1)
    assert path.read_text() == "frames,value,new\n1,,\n"


def test_a_run_folder_of_the_first_version_is_refused_by_the_commit_that_reads_it(tmp_path):
    (tmp_path / "config.yaml").write_text("env:\n  name: hopper\n  backend: gymnasium\n")
    with refused(r"version 0.1.0, which the code of commit 2ebd861 reads"):
        read_config(tmp_path)


@pytest.mark.parametrize(
    "overrides",
    [("env=hopper",), ("collector.num_envs=8",), ("heads.hidden=[32,32]",)],
    ids=["another-task", "another-number-of-environments", "other-heads"],
)
def test_a_checkpoint_of_another_shape_is_refused(smoke, overrides):
    state = load_checkpoint(last_checkpoint(smoke))
    training, _ = assembled(*SMOKE, *overrides)
    with refused("does not fit the settings of this run"):
        training.load_state_dict(state, "there")
