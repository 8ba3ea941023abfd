"""One file for a robot, and an agent saved by itself: each decides as the agent does."""

import ast
import re
import subprocess
import sys

import export as recipe
import pandas as pd
import play
import pytest
import save_agent
import torch
from evaluation.trained import WEIGHTS, load_trained_agent
from evaluation_tools import ROOT, configured, evaluate
from filter_problems import compiles
from recipe_tools import printed, refused

DEPLOY = ROOT / "docs" / "deploy"
WALKER = ROOT / "agents" / "walker2d"
KINDS = [
    pytest.param("export", "p.pt2", id="export"),
    pytest.param("onnx", "p.onnx", id="onnx"),
    pytest.param("aoti", "p.pt2", id="aoti", marks=[compiles, pytest.mark.slow]),
]


def exported(run, out, **changes):
    changes = {"steps": 60, "calls": 20} | changes
    assert recipe.run(configured("export") | {"run": str(run), "out": str(out)} | changes) == 0
    return out


@pytest.mark.parametrize("belief", ["drbpn", "drbpn_propagated"])
@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_a_file_decides_as_the_agent_with_nan_or_a_mask(
    trained_run, tmp_path, capsys, belief, kind, name
):
    run = trained_run(belief)
    out = exported(run, tmp_path / name, format=kind, robots=2)
    printed = capsys.readouterr().out
    steps, missing, largest, difference = re.search(
        r"(\d+) steps, episodes \d+, missing ([\d.]+): actions, at most ([\d.e-]+), differ from "
        r"the agent's by at most ([\d.e-]+)",
        printed,
    ).groups()  # type: ignore[union-attr]
    assert steps == "120"
    assert 0.2 < float(missing) < 0.6
    assert float(difference) < 1e-4 * float(largest)
    assert re.search(r"a decision takes [\d,]+ us", printed)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    decide, g = recipe.load(kind, out), torch.Generator().manual_seed(0)
    x, seen = torch.randn(2, 4, generator=g), torch.tensor([[True, False, True, False]] * 2)
    rest = [torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool), torch.randn(2, 4, generator=g)]
    rest.append(torch.ones(2, 1, dtype=torch.int64))
    if belief == "drbpn_propagated":
        rest.append(0.1 * torch.eye(4).expand(2, 4, 4).contiguous())
    masked = decide(x.where(seen, 1e9), seen, *rest)
    as_nan = decide(x.where(seen, torch.nan), torch.ones_like(seen), *rest)
    assert as_nan[4].tolist() == [[2], [2]]  # rejected
    for i in (0, 1, 2, 3, *range(5, len(masked))):
        torch.testing.assert_close(as_nan[i], masked[i], rtol=0, atol=0)
    assert not torch.equal(decide(x, torch.ones_like(seen), *rest)[0], masked[0])


@pytest.mark.parametrize(
    ("words", "changes", "line"),
    [
        ("gru", {"format": "export"}, "`run` must hold a belief filter .* got belief=gru"),
        ("drbpn belief.emission.cov=full", {}, "`format=onnx`: .* needs a diagonal emission"),
        ("drbpn", {"robust": "huber"}, "`format=onnx`: `sequential` needs .*`robust` None"),
    ],
)
def test_what_has_no_such_form_is_one_line_and_no_file(trained_run, tmp_path, words, changes, line):
    run = trained_run(*words.split())
    out = tmp_path / ("p.pt2" if "format" in changes else "p.onnx")
    with refused(line):
        exported(run, out, **changes)
    assert not list(tmp_path.iterdir())


def test_a_full_noise_covariance_has_another_form(trained_run, tmp_path):
    exported(trained_run("drbpn", "belief.emission.cov=full"), tmp_path / "p.pt2", format="export")


def test_a_missing_package_and_a_missing_compiler_are_named(drbpn, tmp_path, monkeypatch):
    monkeypatch.setattr(recipe, "PACKAGES", ("numpy", "no_such_onnx"))
    with refused("needs no_such_onnx: pip install no_such_onnx"):
        exported(drbpn, tmp_path / "p.onnx")
    monkeypatch.setenv("PATH", str(tmp_path))
    with refused(r"`format=aoti` needs a C\+\+ compiler.*format=export"):
        exported(drbpn, tmp_path / "p.pt2")


def walked(script, policy):
    """The return of a program of docs/deploy, which must import nothing of ours."""
    text = (DEPLOY / script).read_text()
    tree = ast.walk(ast.parse(text))
    modules = {alias.name for node in tree if isinstance(node, ast.Import) for alias in node.names}
    runtime = "onnxruntime" if policy.suffix == ".onnx" else "torch"
    assert modules == {"sys", "gymnasium", "numpy", runtime}
    text = printed(DEPLOY / script, str(policy), cwd=policy.parent)
    return float(re.findall(r"return (-?\d+)", text)[0])


def test_the_program_without_torch_walks(tmp_path):
    assert walked("control_loop_onnx.py", exported(WALKER, tmp_path / "policy.onnx")) > 3000


@pytest.mark.slow
@compiles
def test_the_programs_in_python_and_in_c_walk_and_decide(tmp_path):
    policy = exported(WALKER, tmp_path / "policy.pt2")
    assert walked("control_loop.py", policy) > 3000
    page = (ROOT / "docs" / "deploy.md").read_text()
    (build,) = re.findall(r"```bash\n(T=.*?)```", page, re.DOTALL)
    build = build.replace("docs/deploy/", f"{DEPLOY}/").replace("python ", f"{sys.executable} ")
    done = subprocess.run(
        ["bash", "-ec", build], capture_output=True, text=True, timeout=600, cwd=tmp_path,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.search(r"step 9999, first motor -?\d\.\d+\n[\d.]+ us a step", done.stdout)


@pytest.fixture(scope="module")
def finished(trained_run):
    return trained_run("drbpn", "evaluation.final_episodes=2")


def save(run, out):
    return save_agent.run({"run": run and str(run), "out": out and str(out)})


def test_a_saved_agent_acts_as_the_run_did(finished, tmp_path):
    out = tmp_path / "agents" / "pendulum"
    assert save(finished, out) == 0
    left = {path.name for path in out.iterdir()}
    assert left == {"README.md", WEIGHTS, "config.yaml", "evaluation.csv", "versions.json"}
    first, second = load_trained_agent(finished), load_trained_agent(out)
    assert first.frames == second.frames
    for name, value in first.agent.state_dict().items():  # the normalisation's among them
        assert torch.equal(second.agent.state_dict()[name], value), name
    tables = [
        evaluate(tmp_path / f"{i}.csv", folder, points="'mcar:0.5'")
        for i, folder in enumerate((finished, out))
    ]
    assert tables[0] == [row | {"run": finished.name} for row in tables[1]]
    video = configured("play") | {"run": str(out), "robot": False, "start": 0, "steps": 2}
    assert play.run(video) == 0
    assert (out / "play.gif").is_file()
    card = (out / "README.md").read_text()
    for text in ("# InvertedPendulum-v5, drbpn", "mcar:0.4", "| 128 |", "| seed | 0 |", "sampled"):
        assert text in card


@pytest.mark.parametrize("folder", sorted((ROOT / "agents").iterdir()), ids=lambda path: path.name)
def test_an_agent_of_the_repository_acts_under_this_code(folder, tmp_path):
    trained = load_trained_agent(folder)
    env = trained.environments()(0)
    with torch.no_grad():
        data = env.rollout(200, trained.agent.policy, break_when_any_done=False)
    assert data["action"].isfinite().all()
    card = pd.read_csv(folder / "evaluation.csv").iloc[0]  # whole episodes; these only begin
    assert data["next", "reward"].mean() > 0.5 * card.return_mean / card.length_mean
    video = {"run": str(folder), "robot": False, "start": 0, "steps": 2, "out": tmp_path / "x.gif"}
    assert play.run(configured("play") | video) == 0


def test_a_run_folder_is_not_written_into_and_broken_weights_are_one_line(
    finished, drbpn, tmp_path
):
    with refused("`out` must be a folder for an agent"):
        save(finished, drbpn)
    save(finished, tmp_path / "agent")
    weights = tmp_path / "agent" / WEIGHTS
    weights.write_bytes(weights.read_bytes()[:-40])
    with refused("can't be read as weights"):
        load_trained_agent(tmp_path / "agent")
