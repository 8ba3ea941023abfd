"""The native form: sizes, transformations, wrong arguments, a package built without it."""

import ast
import re
import shutil
import subprocess
import warnings
import zlib
from dataclasses import replace
from pathlib import Path
from platform import machine, system

import pytest
import torch
from filter_problems import Problem, assert_equal, assert_same, built, compiles, recording
from torch.autograd import forward_ad
from torch.backends.cpu import get_cpu_capability
from torch.fx.experimental.proxy_tensor import make_fx

from torchrl_drbpn import BeliefFilter
from torchrl_drbpn.functional import StateSpace, filter_sequence, filtering, native

operator = torch.ops.torchrl_drbpn.filter_rows
ROOT = Path(__file__).parents[1]
WIDTHS = ast.literal_eval(re.search("^WIDTHS = (.*)$", (ROOT / "setup.py").read_text(), re.M)[1])


def libraries(monkeypatch):
    """Put every library that the processor runs in the place of its own, in turn."""
    wide = {"AVX512": 3, "AVX2": 2}.get(get_cpu_capability(), 1)
    for name in list(WIDTHS)[:wide]:
        library = native.load(next(ROOT.glob(f"torchrl_drbpn/_native_{name}.*")))
        native._tape_of_a_group.cache_clear()
        monkeypatch.setattr(native, "_library", lambda library=library: library)
        yield library
    native._tape_of_a_group.cache_clear()


@built
@pytest.mark.parametrize(
    ("batch", "time", "state", "obs"),
    [
        (1, 1, 2, 1), (4, 6, 3, 3), (9, 3, 17, 17), (3, 11, 20, 17), (33, 2, 5, 4), (2, 2, 64, 64),
        (1, 1, 1, 2), (4, 6, 2, 5), (17, 3, 5, 105), (3, 11, 17, 27), (33, 2, 8, 9), (2, 2, 64, 70),
    ],
)  # fmt: skip
@pytest.mark.parametrize("propagated", [False, True], ids=["constant", "propagated"])
def test_every_size_equals_the_pytorch_form(batch, time, state, obs, propagated):
    problem = Problem(
        state, obs, batch=batch, time=time, hidden=(8, 5), activation="relu", stored=time > 2,
        propagated=propagated,
    )  # fmt: skip
    assert_same(problem, problem.library("native"), problem.library("pytorch"), 1e-9)


@built
@pytest.mark.parametrize(
    ("obs", "propagated"), [(3, False), (5, False), (5, True)], ids=["obs", "state", "F"]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_it_passes_the_checks_of_torch_library(obs, dtype, propagated):
    problem = Problem(3, obs, stored=True, dtype=dtype, propagated=propagated)
    arguments = tuple(problem.operator_arguments())
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    found = torch.library.opcheck(operator, arguments, test_utils=checks)
    assert set(found.values()) == {"SUCCESS"}


@built
def test_a_trace_knows_that_gradients_are_dense_whatever_the_input_was():
    problem = Problem(3, 5)
    arguments = [
        x.detach() if isinstance(x, torch.Tensor) else x for x in problem.operator_arguments()
    ]
    arguments[17] = [x.detach() for x in arguments[17]]
    arguments[0] = arguments[0].mT.contiguous().mT
    mean, ll, tape, _ = operator(*arguments)
    given = (torch.ones_like(mean), torch.ones_like(ll), tape, *arguments)
    backward = torch.ops.torchrl_drbpn.filter_rows_backward
    found = torch.library.opcheck(backward, given, test_utils="test_faketensor")
    assert set(found.values()) == {"SUCCESS"}


@built
@pytest.mark.parametrize("propagated", [False, True])
def test_vmap_over_it_equals_a_loop(propagated):
    arguments = Problem(3, 5, propagated=propagated).operator_arguments()
    arguments = [x.detach() if isinstance(x, torch.Tensor) else x for x in arguments]
    observation = torch.stack([arguments[0], 2 * arguments[0]], -1)
    networks = [torch.stack([x.detach(), -x.detach()]) for x in arguments[17]]

    def run(x, f):
        mean, ll, _, cov = operator(x, *arguments[1:17], f, *arguments[18:])
        return mean, ll, cov

    found = torch.vmap(run, in_dims=(-1, 0))(observation, networks)
    for i in range(2):
        expected = run(observation[..., i], [x[i] for x in networks])
        for a, b in zip(found, expected, strict=True):
            assert torch.equal(a[i], b)


@built
def test_traces_meet_an_operator():
    problem = Problem(3, 5)
    model, (mean, *rest) = problem.model(), problem.arguments()
    with torch.no_grad():
        traced = make_fx(lambda m: filter_sequence(model, m, *rest).mean)(mean)
        assert_equal(traced(mean + 1), filter_sequence(model, mean + 1, *rest).mean)
    below = torch.ops.torchrl_drbpn.filter_rows_forward.default  # without its derivative
    assert any(node.target is below for node in traced.graph.nodes)


@built
@pytest.mark.parametrize("fullgraph", [False, True])
@pytest.mark.parametrize("propagated", [False, True])
def test_a_compiled_graph_holds_it_and_serves_every_batch(propagated, fullgraph):
    graphs = []

    torch._dynamo.reset()  # it remembers which sizes have moved
    compiled = torch.compile(filter_sequence, fullgraph=fullgraph, backend=recording(graphs))
    for batch, time in ((3, 7), (4, 7), (9, 8), (2, 5), (8, 2), (5, 5)):
        problem = Problem(3, 5, batch=batch, time=time, propagated=propagated)
        given, start = (problem.model(), *problem.arguments()), {"cov": problem.start_cov}
        found, expected = compiled(*given, **start), filter_sequence(*given, **start)
        for name in ("mean", "log_likelihood"):
            assert torch.equal(getattr(found, name), getattr(expected, name))
    assert len(graphs) == 3  # one size, one time, any
    assert all(operator in [node.target for node in graph.graph.nodes] for graph in graphs)


@built
def test_what_it_does_not_take_it_names():
    problem = Problem(2, 3)
    model, reason = problem.model(), native.unsupported_reason
    assert reason(model) is None
    assert reason(model, torch.zeros(2)) == "the dtypes differ"
    assert reason(model, torch.zeros(2, device="meta").double()) == "it runs on the CPU"
    assert "TransitionMLP" in reason(replace(model, transition=lambda m, _: m))
    assert "constant" in reason(replace(model, transition_cov=lambda m, _: m))
    assert "diagonal" in reason(Problem(2, 3, propagated=True, full_noise=True).model())
    assert "nothing" in reason(model, torch.zeros(0, 3).double())
    assert reason(Problem(2, 65, full_noise=True).model()) == "obs is 65, more than 64"
    assert reason(Problem(2, 65).model()) is None  # 2 x 2 is factorised
    assert reason(Problem(65, 66).model()) == "state is 65, more than 64"
    f, fields = model.transition, list(vars(model))[1:8]
    weights, biases = (tuple(x.half() for x in part) for part in (f.weights, f.biases))
    f = f._replace(weights=weights, biases=biases)
    half = StateSpace(f, *(getattr(model, name).half() for name in fields))
    assert reason(half) == "there is none for torch.float16"

    class Own(torch.Tensor):
        pass

    assert reason(model, torch.zeros(2).double().as_subclass(Own)) == "Own is a class of its own"
    with forward_ad.dual_level():
        assert reason(model) == "it has no forward-mode derivative"
    found = []
    torch.func.vmap(lambda x: found.append(reason(model, x)) or x)(torch.zeros(2, 2).double())
    assert found == ["torch.func transforms PyTorch's operations"]


@pytest.mark.parametrize("place", range(19))
@pytest.mark.parametrize("spoil", ["size", "dtype", "dimension", "device"])
def test_a_wrong_tensor_never_reaches_c(place, spoil):
    arguments = Problem(3, 5, stored=True, propagated=True).operator_arguments()
    holder, at = (arguments, place) if place < 17 else (arguments[17], place - 17)
    x = holder[at]
    spoilt = {
        "size": x[..., :-1], "dtype": x.to(torch.int32), "dimension": x.unsqueeze(0),
        "device": x.to("meta"),
    }  # fmt: skip
    holder[at] = spoilt[spoil]
    with pytest.raises(
        (ValueError, NotImplementedError, RuntimeError), match=r"must be|meta|device"
    ):
        operator(*arguments)


WHOLE = r"beside `stored`|come with `cov`"
LAYERS = r"must be|last width|no size"
KEPT = ([], [0], [0, 1], [0, 1, 2], [1, 0, 2, 3], [0, 1, 2, 3, 2, 3])  # of weight, bias, ...
PARTS = [*((i, None, WHOLE) for i in (4, 5, 7, 8)), *((17, kept, LAYERS) for kept in KEPT)]


@pytest.mark.parametrize(("place", "kept", "line"), PARTS, ids=str)
@pytest.mark.parametrize("width", [slice(None), slice(0)], ids=["whole", "empty"])
def test_half_a_belief_and_layers_that_are_no_network_never_reach_c(place, kept, line, width):
    belief = {"stored": True, "propagated": True} if kept is None else {}
    arguments = Problem(3, 5, **belief).operator_arguments()
    arguments[place] = kept and [arguments[place][i][width] for i in kept]
    with pytest.raises(ValueError, match=line):
        operator(*arguments)


@built
def test_a_tape_of_another_call_never_reaches_c():
    arguments = Problem(3, 5).operator_arguments()
    mean, ll, tape, _ = operator(*arguments)
    backward = torch.ops.torchrl_drbpn.filter_rows_backward
    for wrong in ((mean, ll, tape[:-1]), (mean[:1], ll, tape), (mean, ll.float(), tape)):
        with pytest.raises(ValueError, match=r"`tape` must be|like the outputs"):
            backward(*(x.detach() for x in wrong), *arguments)


@built
@pytest.mark.parametrize(("obs", "r"), [(3, -100.0), (5, -1e-3)], ids=["innovation", "information"])
def test_a_covariance_that_cannot_be_factorised_spoils_its_own_row_alone(obs, r):
    problem = Problem(3, obs, batch=5, resets=False)
    bad = replace(problem.model(), emission_cov=r * torch.ones(obs).double())
    start, action, x, _, reset = problem.arguments()
    nothing = torch.zeros_like(problem.observed)
    seen = nothing.clone()
    seen[2, 3] = True  # the only observation that arrives
    for form in ("native", "pytorch"):
        out = filter_sequence(bad, start, action, x, seen, reset, form=form)
        expected = filter_sequence(bad, start, action, x, nothing, reset, form=form)
        assert out.log_likelihood[2, 3].isnan()
        assert out.mean[2, 3:].isnan().all()
        rows = [0, 1, 3, 4]
        assert torch.equal(out.mean[rows], expected.mean[rows])
        assert torch.equal(out.mean[2, :3], expected.mean[2, :3])


def test_a_package_built_without_it_filters_in_pytorch_and_says_so_once(monkeypatch):
    filtering._warn_once.cache_clear()
    monkeypatch.setattr(native, "_library", lambda: "the package was built without it")
    problem = Problem(3, 5)
    with pytest.warns(UserWarning, match="runs in PyTorch.*built without it"):
        found = problem.library("auto")
    assert_same(problem, found, problem.library("pytorch"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.library("auto")
    with pytest.raises(ValueError, match="'native' cannot run here: the package was built without"):
        problem.library("native")
    filtering._warn_once.cache_clear()


GCC = (system(), machine()) == ("Linux", "x86_64") and shutil.which("gcc") is not None


@pytest.mark.skipif(not GCC, reason="of gcc on x86")
@pytest.mark.parametrize("flags", WIDTHS.values(), ids=WIDTHS)
def test_no_width_of_vectors_is_taken_apart_by_the_compiler(flags, tmp_path):
    """Vectors wider than the processor's lie in memory: the filter took 9 to 14 times as long."""
    warn = ["-Wvector-operation-performance", "-Werror", "-o", tmp_path / "filter.o"]
    source = ROOT / "torchrl_drbpn/csrc/filter_float.c"
    subprocess.run(["gcc", "-std=gnu11", "-O1", "-c", source, *flags, *warn], check=True)


@built
@pytest.mark.parametrize("propagated", [False, True], ids=["constant", "propagated"])
@pytest.mark.parametrize("obs", [3, 9])
def test_the_libraries_of_all_widths_say_the_same(obs, propagated, monkeypatch):
    problem = Problem(5, obs, batch=3, time=5, stored=True, propagated=propagated)
    for _ in libraries(monkeypatch):
        assert_same(problem, problem.library("native"), problem.library("pytorch"), 1e-9)


@built
@compiles
def test_what_was_compiled_for_another_library_is_not_taken_from_the_disk(monkeypatch, tmp_path):
    """A cached graph holds how long the tape is, and differs where another library is installed."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    belief_filter, g = BeliefFilter(5, 1), torch.Generator().manual_seed(0)
    start, action, x = (torch.randn(*n, generator=g) for n in ((3, 5), (3, 7, 1), (3, 7, 5)))
    given = (start, None, action, x, x > 0, torch.zeros(3, 7, dtype=torch.bool))
    for _ in libraries(monkeypatch):
        torch._dynamo.reset()
        found = torch.compile(belief_filter, fullgraph=True)(*given)
        assert_equal(found[0], belief_filter(*given)[0], 1e-5)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("code", ["", "long abi_float(void) { return -1; }"], ids=["none", "other"])
def test_a_library_of_another_abi_is_left_alone_and_says_to_rebuild(code, tmp_path):
    source, built = tmp_path / "old.c", tmp_path / "_native_old.so"
    source.write_text(f"long forward_float(void) {{ return 0; }} {code}")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", built, source], check=True)
    reason = native.load(built)
    assert isinstance(reason, str)
    assert "pip install -e ." in reason
    assert "\n" not in reason


def test_what_passes_between_python_and_c_has_an_abi_number_of_its_own():
    """Where this fails: raise ABI in filter.h and in native.py, build, and write both here."""
    files = sorted((Path(native.__file__).parents[1] / "csrc").glob("*.h"))
    lines = [line for file in files for line in file.read_text().splitlines()]
    number = next(int(line.split()[2]) for line in lines if line.startswith("#define ABI"))
    passed = "".join(line for line in lines if re.search(r"\b[pd]\[|\bp \+", line))
    assert (native._ABI, number, zlib.crc32("".join(passed.split()).encode())) == (1, 1, 1188242560)
