"""What holds for every test: the native filter is this checkout's, global states are given back."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]


def pytest_configure(config):
    """Build the native filter where it is not there or older than its source; optional as ever."""
    config.addinivalue_line("filterwarnings", "ignore:the filter runs in PyTorch")
    sources = [*ROOT.glob("torchrl_drbpn/csrc/*"), ROOT / "setup.py"]
    there = [path.stat().st_mtime for path in ROOT.glob("torchrl_drbpn/_native_*")]
    if not there or min(there) < max(path.stat().st_mtime for path in sources):
        build = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
        subprocess.run(build, cwd=ROOT, check=False)


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")


@pytest.fixture(scope="session")
def smoke(tmp_path_factory):
    """Run the smoke experiment of the recipe once, to its end; nobody may change its folder."""
    from recipe_tools import SMOKE, run

    folder = tmp_path_factory.mktemp("run") / "smoke"
    assert run(folder, *SMOKE) == 0
    return folder


@pytest.fixture
def folder(smoke, tmp_path):
    """A copy of the run of the smoke experiment, to go on with or to spoil."""
    return shutil.copytree(smoke, tmp_path / "copy")


@pytest.fixture
def own_directory(tmp_path, monkeypatch):
    """MuJoCo writes the warnings of a model file into the current directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def _global_state():
    """Recipes set both; no test may depend on which one ran before, or on its luck."""
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory):
    """Run folders after one rollout with two fifths missing, each made once: not to be written."""
    from recipe_tools import make_folder

    made: dict[tuple[str, ...], Path] = {}

    def folder(belief="drbpn", *overrides):
        key = (belief, *overrides)
        if key not in made:
            path = tmp_path_factory.mktemp("runs") / belief
            made[key] = make_folder(path, f"belief={belief}", *overrides)
        return made[key]

    return folder


@pytest.fixture(scope="session")
def drbpn(trained_run):
    return trained_run()


@pytest.fixture(scope="module")
def agent(drbpn):
    from evaluation.trained import load_trained_agent

    return load_trained_agent(drbpn)


@pytest.fixture
def young(drbpn, tmp_path):
    """The folder of a run that has no checkpoint yet."""
    (tmp_path / "young").mkdir()
    shutil.copy(drbpn / "config.yaml", tmp_path / "young")
    return tmp_path / "young"


@pytest.fixture(scope="session")
def feedforward(trained_run):
    return trained_run("none")
