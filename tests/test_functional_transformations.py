"""What PyTorch does to functions works on the filter: the values and gradients of a plain call."""

import contextlib
from dataclasses import replace

import pytest
import torch
from filter_problems import Problem, assert_equal
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad

from torchrl_drbpn.functional import filter_sequence

SIZES = pytest.mark.parametrize(
    ("obs", "propagated"),
    [(3, False), (5, False), (3, True), (5, True)],
    ids=["innovation", "information", "propagated innovation", "propagated information"],
)


def total(problem, form="auto"):
    """A number of the start mean and of R, everything else fixed."""
    problem.leaves = {name: leaf.detach() for name, leaf in problem.leaves.items()}
    model, (_, *rest) = problem.model(), problem.arguments()
    stored = {**problem.stored(), "cov": problem.start_cov}

    def run(start, noise):
        noisy = replace(model, emission_cov=noise)
        out = filter_sequence(noisy, start, *rest, **stored, form=form)
        return out.mean.square().sum() + out.log_likelihood.sum()

    return run, (problem.leaves["start_mean"], problem.leaves["noise"])


@SIZES
def test_func_grad_and_jvp_equal_autograd(obs, propagated):
    run, given = total(Problem(3, obs, propagated=propagated, stored=True))
    leaves = [x.clone().requires_grad_() for x in given]
    expected = torch.autograd.grad(run(*leaves), leaves)
    for a, b in zip(torch.func.grad(run, (0, 1))(*given), expected, strict=True):
        assert_equal(a, b)
    directions = tuple(torch.ones_like(x) for x in given)
    slope = sum(g.sum() for g in expected)
    assert_equal(torch.func.jvp(run, given, directions)[1], slope)
    with forward_ad.dual_level():
        duals = (forward_ad.make_dual(x, d) for x, d in zip(given, directions, strict=True))
        assert_equal(forward_ad.unpack_dual(run(*duals)).tangent, slope)


@SIZES
def test_vmap_over_models_and_gradients_a_sample_equal_loops(obs, propagated):
    run, (start, noise) = total(Problem(3, obs, propagated=propagated))
    noises = torch.stack([noise, 2 * noise])
    found = torch.vmap(torch.func.grad(run, 1), in_dims=(None, 0))(start, noises)
    for a, b in zip(found, noises, strict=True):
        assert_equal(a, torch.func.grad(run, 1)(start, b))


@SIZES
@pytest.mark.parametrize("form", ["auto", "pytorch"])
def test_compiled_in_one_graph_it_is_the_same(obs, propagated, form):
    run, given = total(Problem(3, obs, propagated=propagated, stored=True, time=3), form)
    compiled = torch.compile(run, fullgraph=True, backend="aot_eager")
    leaves = [[x.clone().requires_grad_() for x in given] for _ in range(2)]
    values = compiled(*leaves[0]), run(*leaves[1])
    assert_equal(*values)
    for value in values:
        value.backward()
    for a, b in zip(*leaves, strict=True):
        assert_equal(a.grad, b.grad)


@SIZES
def test_transformed_inside_a_compiled_function_it_is_the_same(obs, propagated):
    run, (start, noise) = total(Problem(3, obs, propagated=propagated, time=2))

    def change(start, noise):
        slope = torch.func.jvp(run, (start, noise), (start, noise))[1]
        return slope, torch.func.grad(run, (0, 1))(start, noise)

    with forward_ad.dual_level():
        dual = torch.compile(run, backend="eager")(forward_ad.make_dual(start, start), noise)
        tangent = forward_ad.unpack_dual(dual).tangent
    assert_equal(tangent, torch.func.jvp(lambda x: run(x, noise), (start,), (start,))[1])
    compiled = torch.compile(change, fullgraph=True, backend="aot_eager")
    (slope, found), (wanted, grads) = compiled(start, noise), change(start, noise)
    for a, b in zip((slope, *found), (wanted, *grads), strict=True):
        assert_equal(a, b)


@SIZES
def test_exported_it_is_the_same(obs, propagated):
    run, given = total(Problem(3, obs, propagated=propagated, time=3))

    class Module(torch.nn.Module):
        def forward(self, start, noise):
            return run(start, noise)

    with torch.no_grad():
        for strict in (False, True):
            exported = torch.export.export(Module(), given, strict=strict)
            assert_equal(exported.module()(*given), run(*given))
            assert "torchrl_drbpn" not in str(exported.graph)  # it runs where this package is not


@SIZES
def test_fake_and_meta_tensors_give_shapes(obs, propagated):
    mode = FakeTensorMode()
    for moved in (mode.from_tensor, lambda x: x.to("meta")):
        problem = Problem(3, obs, propagated=propagated, batch=2, time=4)
        problem.leaves = {name: moved(leaf.detach()) for name, leaf in problem.leaves.items()}
        for name in ("observed", "reset", "jacobian", "start_cov"):
            value = getattr(problem, name)
            setattr(problem, name, None if value is None else moved(value))
        with mode if moved == mode.from_tensor else contextlib.nullcontext():
            mean, _, ll = problem.library("auto")
        assert (tuple(mean.shape), tuple(ll.shape)) == ((2, 4, 3), (2, 4))
    assert mean.is_meta


@SIZES
def test_a_tensor_class_of_its_own_and_autocast_change_nothing(obs, propagated):
    class Own(torch.Tensor):
        pass

    problem = Problem(3, obs, propagated=propagated, dtype=torch.float32)
    run, given = total(problem)
    expected = run(*given)
    found = run(*(x.as_subclass(Own) for x in given))
    assert isinstance(found, Own)
    assert_equal(found.as_subclass(torch.Tensor), expected, 1e-3)
    model = problem.model()
    for form in ("pytorch", "auto"):
        options = {"return_cov": True, "form": form, "cov": problem.start_cov}
        plain = filter_sequence(model, *problem.arguments(), **options)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            cast = filter_sequence(model, *problem.arguments(), **options)
        for a, b in zip(cast, plain, strict=True):
            assert torch.equal(a, b)
