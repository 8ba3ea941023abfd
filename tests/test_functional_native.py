"""The filter in C, where it differs from the other forms: machine, sizes, fallback.

Its values and gradients are held to the row-deleting oracle beside the other forms in
test_functional_filtering.py. Specified here:

- batches that fill no, one or several groups of the vectorised factorisation, and one sensor as
  well as the most, give the numbers of the PyTorch forms, with gradients;
- the information form without an observation gives the prediction, and 0 likelihood exactly;
- one covariance that cannot be factorised spoils its own row, no other;
- a step without a gradient runs it too; under torch.func and with a gradient PyTorch runs;
- without a compiler, with one that fails, or switched off: "auto" runs PyTorch and "native" says
  why it cannot; a library that was compiled once is not compiled again until its source, or a
  file that this includes, is another.
"""

from __future__ import annotations

import pytest
import torch
from filter_problems import Problem, assert_equal, assert_same

from torchrl_drbpn.functional import (
    choose_form,
    compiled,
    filter_sequence,
    filter_step,
    native,
)

# A compiler that refuses the file is no reason to skip.
pytestmark = pytest.mark.skipif(
    "there is no C compiler" in (compiled.native_error() or ""), reason="no C compiler here"
)


@pytest.fixture
def forgetful(monkeypatch, tmp_path):
    """No library loaded yet, and an empty cache folder."""
    for cached in (compiled.load_library, compiled.native_error):
        cached.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    yield tmp_path
    for cached in (compiled.load_library, compiled.native_error):
        cached.cache_clear()


@pytest.mark.parametrize(
    ("batch", "time", "state", "obs"),
    [(1, 1, 2, 1), (4, 6, 3, 3), (9, 3, 17, 17), (3, 11, 20, 17), (33, 2, 5, 4), (2, 2, 64, 64)],
)
def test_every_size_equals_the_pytorch_form(batch, time, state, obs):
    problem = Problem(state, obs, batch=batch, time=time, hidden=(8, 5), activation="relu")
    assert_same(problem, problem.fast("native"), problem.fast("innovation"), 1e-9)


@pytest.mark.parametrize(
    ("batch", "time", "state", "obs"),
    [(1, 1, 1, 2), (4, 6, 2, 5), (17, 3, 5, 105), (3, 11, 17, 27), (33, 2, 8, 9), (2, 2, 64, 70)],
)
def test_every_size_of_the_information_form_equals_the_pytorch_form(batch, time, state, obs):
    problem = Problem(
        state, obs, batch=batch, time=time, hidden=(8, 5), activation="relu", restarts=time > 2
    )
    assert choose_form(problem.model()) == "information"
    assert_same(problem, problem.fast("native"), problem.fast("information"), 1e-10)


def test_where_nothing_was_observed_the_information_form_predicts_exactly():
    problem = Problem(3, 7, time=1)
    problem.observed = torch.zeros_like(problem.observed)
    model, (start, action, *_, reset) = problem.model(), problem.arguments()
    mean, _, ll = problem.fast("native")
    moved = torch.where(reset, model.initial_mean, model.transition(start, action[:, 0]))
    assert_equal(mean[:, 0], moved, 1e-14)
    assert torch.equal(ll, torch.zeros_like(ll))
    gradients = problem.gradients((ll,))
    assert not any(gradient.any() for gradient in gradients.values())


def test_a_covariance_that_cannot_be_factorised_spoils_its_own_row_alone():
    problem = Problem(3, 3, batch=5, resets=False)
    bad = problem.model()._replace(emission_cov=-torch.ones(3, dtype=torch.float64))
    start, action, x, _, reset = problem.arguments()
    nothing = torch.zeros_like(problem.observed)
    seen = nothing.clone()
    seen[2, 3] = True  # the only observation that arrives
    out = filter_sequence(bad, start, action, x, seen, reset, form="native")
    expected = filter_sequence(bad, start, action, x, nothing, reset, form="native")
    assert out.log_likelihood[2, 3].isnan()
    rows = [0, 1, 3, 4]
    assert torch.equal(out.mean[rows], expected.mean[rows])
    assert torch.equal(out.mean[2, :3], expected.mean[2, :3])


@pytest.mark.parametrize("obs", [4, 9], ids=["innovation", "information"])
def test_a_step_is_a_sequence_of_one_and_differentiable_as_often_as_wanted(obs):
    problem = Problem(4, obs, batch=6, time=1)
    model, (start, action, x, seen, reset) = problem.model(), problem.arguments()
    arguments = (start, action[:, 0], x[:, 0], seen[:, 0], reset[:, 0])
    slow = filter_step(model, *arguments)
    with torch.no_grad():
        fast = filter_step(model, *arguments)
        mapped = torch.func.vmap(lambda *a: filter_step(model, *a).mean)(*arguments)
    for value in (fast.mean, mapped):
        assert_equal(value, slow.mean.detach())
    assert_equal(fast.log_likelihood, slow.log_likelihood.detach())
    (once,) = torch.autograd.grad(slow.log_likelihood.sum(), start, create_graph=True)
    assert torch.autograd.grad(once.square().sum(), start)[0].any()


@pytest.mark.parametrize(
    ("variable", "value", "reason"),
    [
        ("CC", "/nowhere/cc", "there is no C compiler"),
        ("CC", "false", "`false` refused native.c"),
        ("TORCHRL_DRBPN_NATIVE", "0", "switches it off"),
    ],
)
def test_without_a_library_auto_runs_pytorch_and_native_says_why(
    forgetful, monkeypatch, variable, value, reason
):
    monkeypatch.setenv(variable, value)
    problem = Problem(4, 4)
    for a, b in zip(problem.fast("auto"), problem.fast("innovation"), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(ValueError, match=f"`form` 'native' cannot run here: .*{reason}"):
        problem.fast("native")
    assert not list(forgetful.rglob("*.so"))


def test_without_a_home_there_is_no_library_and_no_error(forgetful, monkeypatch):
    def homeless(cls):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(compiled.Path, "home", classmethod(homeless))
    assert "XDG_CACHE_HOME: Could not determine home" in compiled.native_error()
    Problem(4, 4).fast("auto")


def test_a_library_is_compiled_once(forgetful):
    assert compiled.native_error(torch.float64) is None
    (library,) = forgetful.rglob("*.so")
    written = library.stat().st_mtime_ns
    for cached in (compiled.load_library, compiled.native_error):
        cached.cache_clear()
    assert compiled.native_error(torch.float64) is None
    assert [p for p in forgetful.rglob("*") if p.is_file()] == [library]
    assert library.stat().st_mtime_ns == written


def test_a_change_in_an_included_file_compiles_anew(forgetful, monkeypatch):
    folder = forgetful / "source"
    folder.mkdir()
    monkeypatch.setattr(compiled, "_FOLDER", folder)
    (folder / "native.c").write_text('#include "outer.h"\nint answer(void) { return ANSWER; }\n')
    (folder / "outer.h").write_text('#include <math.h>\n#include "inner.h"\n')
    for answer in (1, 2):
        (folder / "inner.h").write_text(f"#define ANSWER {answer}\n")
        compiled.load_library.cache_clear()
        assert compiled.load_library(torch.float32).answer() == answer
    assert len(list(forgetful.rglob("*.so"))) == 2


def test_what_it_does_not_take_it_names():
    problem = Problem(3, 3)
    model = problem.model()
    assert native.native_refusal(model, torch.zeros(2)) == "the dtypes differ"
    meta = torch.zeros(2, dtype=torch.float64, device="meta")
    assert native.native_refusal(model, meta) == "it runs on the CPU"
    many_sensors = Problem(2, 65, full_noise=True).model()
    assert native.native_refusal(many_sensors) == "obs is 65, more than 64"
    assert native.native_refusal(Problem(2, 65).model()) is None  # 2 x 2 is factorised
    large = Problem(65, 66).model()
    assert native.native_refusal(large) == "state is 65, more than 64"


@pytest.mark.parametrize(("n", "count"), [(1, 1), (3, 8), (17, 21), (64, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_many_inverses_at_once_are_those_of_lapack(n, count, dtype):
    g = torch.Generator().manual_seed(n)
    root = torch.randn(count, n, n, generator=g, dtype=torch.float64)
    matrix = (root @ root.mT + n * torch.eye(n, dtype=torch.float64)).to(dtype)
    found = compiled.spd_inverse(matrix.tril())  # the upper triangle is not read
    assert found is not None
    tolerance = {"rtol": 1e-4, "atol": 1e-5} if dtype == torch.float32 else {}
    torch.testing.assert_close(found[0], torch.linalg.inv(matrix), **tolerance)
    torch.testing.assert_close(found[1], torch.logdet(matrix), **tolerance)
    spoiled = matrix.clone()
    spoiled[-1] -= 1e4 * torch.eye(n, dtype=dtype)
    inverse, _ = compiled.spd_inverse(spoiled)
    assert inverse[-1].isnan().all()
    assert torch.equal(inverse[:-1], found[0][:-1])


def test_matrices_too_large_for_a_group_go_to_lapack():
    assert compiled.spd_inverse(torch.eye(65)) is None
