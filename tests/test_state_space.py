"""What the learned state-space model is held to: eq. (2), (3), (8) [DRBPN] and their noise."""

import functools
import itertools

import pytest
import references
import torch
from refusals import refuses

from torchrl_drbpn import GaussianTransition, LinearGaussianEmission

STATE, ACTION, OBS = 3, 2, 5
F64 = torch.float64
COVS = list(itertools.product(("diag", "full"), (False, True)))


def inputs(batch=(7,), seed=0):
    g = torch.Generator().manual_seed(seed)
    randn = functools.partial(torch.randn, *batch, generator=g, dtype=F64)
    return randn(STATE), randn(ACTION)


def scramble(module, scale, seed=0):
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(scale * torch.randn(parameter.shape, generator=g, dtype=F64))


def assert_covariance(matrix, floor, cov):
    eigenvalues = torch.linalg.eigvalsh(matrix)
    assert torch.equal(matrix, matrix.mT)
    assert (eigenvalues >= floor**2 - 1e-12 * eigenvalues[..., -1:]).all()
    if cov == "diag":
        assert torch.equal(matrix, torch.diag_embed(matrix.diagonal(dim1=-2, dim2=-1)))


@pytest.mark.parametrize(("cov", "cov_network"), COVS)
@pytest.mark.parametrize("std", [0.3, 0.06, 5.0])
def test_q_starts_at_init_std_and_keeps_its_floor_whatever_the_parameters(cov, cov_network, std):
    transition = GaussianTransition(
        STATE, ACTION, hidden_sizes=(8,), cov=cov, cov_network=cov_network, min_std=0.05,
        init_std=std, dtype=F64,
    )  # fmt: skip
    assert {parameter.dtype for parameter in transition.parameters()} == {F64}
    expected = (std**2 * torch.eye(STATE, dtype=F64)).expand(7, -1, -1)
    torch.testing.assert_close(transition(*inputs()).cov, expected, rtol=1e-12, atol=1e-14)
    for scale, seed in itertools.product((0.5, 5.0), (0, 1)):
        scramble(transition, scale, seed)
        assert_covariance(transition(*inputs(seed=seed)).cov, 0.05, cov)
    # where the likelihood pulls the noise to zero
    target = transition.noise.raw if not cov_network else transition.cov_layers[-1].bias
    with torch.no_grad():
        target.fill_(-1e3)
    assert_covariance(transition(*inputs()).cov, 0.05, cov)


@pytest.mark.parametrize("cov_network", [False, True])
def test_a_network_q_depends_on_mean_and_action_and_a_free_one_does_not(cov_network):
    transition = GaussianTransition(STATE, ACTION, cov="full", cov_network=cov_network, dtype=F64)
    scramble(transition, 0.5)
    mean, action = inputs()
    q = transition(mean, action).cov
    for changed in ((mean + 1, action), (mean, action + 1)):
        assert torch.equal(transition(*changed).cov, q) is not cov_network
    assert (transition.noise is None) is cov_network


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("hidden", [(), (8,), (8, 6)])
def test_the_mean_is_the_network_of_mean_and_action(residual, activation, hidden):
    transition = GaussianTransition(
        STATE, ACTION, hidden_sizes=hidden, activation=activation, residual=residual, dtype=F64
    )
    mean, action = inputs((2, 3))
    weights = [layer.weight for layer in transition.layers]
    biases = [layer.bias for layer in transition.layers]
    expected = references.mean_network(weights, biases, residual, activation)(mean, action)
    torch.testing.assert_close(transition(mean, action).mean, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("state", [3, 5, 8])
def test_the_emission_starts_as_the_first_rows_or_columns_of_the_identity(state):
    emission = LinearGaussianEmission(OBS, state, ACTION, dtype=F64)
    s = torch.randn(4, state, dtype=F64)
    n = min(OBS, state)
    out = emission(s, torch.randn(4, ACTION, dtype=F64))
    assert torch.equal(out[:, :n], s[:, :n])
    assert not out[:, n:].any()


def test_the_expected_observation_is_h_s_plus_b_a_plus_d():
    emission = LinearGaussianEmission(OBS, STATE, ACTION, dtype=F64)
    scramble(emission, 1.0)
    s, a = inputs((4, 2))
    received = emission(s, a)
    for i, j in itertools.product(range(4), range(2)):
        expected = emission.matrix @ s[i, j] + emission.action_matrix @ a[i, j] + emission.offset
        torch.testing.assert_close(received[i, j], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("cov", ["diag", "full"])
@pytest.mark.parametrize("std", [0.1, 2.0])
def test_r_starts_exactly_at_init_std_and_keeps_its_floor(cov, std):
    emission = LinearGaussianEmission(OBS, STATE, ACTION, cov=cov, init_std=std, dtype=F64)
    expected = std**2 * torch.eye(OBS, dtype=F64)
    torch.testing.assert_close(emission.cov(), expected, rtol=1e-12, atol=1e-14)
    for scale in (0.5, 5.0):
        scramble(emission, scale)
        r, compact = emission.cov(), emission.compact_cov()
        assert torch.equal(compact, r.diagonal() if cov == "diag" else r)
        assert_covariance(r, emission.noise.min_std, cov)


def test_a_fixed_matrix_is_saved_but_not_learned():
    emission = LinearGaussianEmission(OBS, 7, ACTION, fixed_matrix=True)
    assert "matrix" in emission.state_dict()
    assert "matrix" not in dict(emission.named_parameters())
    assert torch.equal(emission.matrix, torch.eye(OBS, 7))


MODULES = {
    "network Q": GaussianTransition(STATE, ACTION, cov="full", cov_network=True),
    "free Q": GaussianTransition(STATE, ACTION),
    "emission": LinearGaussianEmission(OBS, STATE, ACTION, cov="full"),
}


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
def test_reset_parameters_go_back_to_the_start(module):
    def noise():
        if isinstance(module, LinearGaussianEmission):
            return module.cov()
        return module.cov(torch.ones(STATE), torch.ones(ACTION))

    start = noise().detach().clone()
    before = [parameter.detach().clone() for parameter in module.parameters()]
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += 1000
    module.reset_parameters()
    torch.testing.assert_close(noise(), start)
    for parameter, old in zip(module.parameters(), before, strict=True):
        assert (parameter - old).abs().max() < 10


@pytest.mark.parametrize("value", [0, -1, 2.0, True])
@pytest.mark.parametrize("name", ["state_dim", "action_dim", "obs_dim"])
def test_a_dimension_that_is_no_positive_int_is_refused(name, value):
    dims = {"state_dim": STATE, "action_dim": ACTION, name: value}
    message = f"`{name}` must be an int of at least 1, got {value}"
    if name != "obs_dim":
        with pytest.raises(ValueError, match=message):
            GaussianTransition(**dims)
    with pytest.raises(ValueError, match=message):
        LinearGaussianEmission(**{"obs_dim": OBS, **dims})


Q = functools.partial(GaussianTransition, STATE, ACTION)
R = functools.partial(LinearGaussianEmission, OBS, STATE, ACTION)


test_wrong_use_is_refused = refuses(
    *[(functools.partial(make, **kwargs), message) for make in (Q, R) for kwargs, message in (
        ({"cov": "scalar"}, "`cov` must be one of diag, full, got 'scalar'"),
        ({"init_std": 0.01, "min_std": 0.02}, "`min_std` and `init_std` must satisfy"),
        ({"min_std": 0.0}, "0 < min_std < init_std, got min_std=0"),
        ({"init_std": float("nan")}, "`min_std` and `init_std` must satisfy"),
    )],
    (lambda: Q(activation="gelu"), "`activation` must be one of relu, tanh, got 'gelu'"),
    (lambda: Q(cov_network=True).cov(), "`mean` and `action` are needed"),
    (lambda: R(fixed_matrix=True), "`fixed_matrix` needs state_dim >= obs_dim"),
)  # fmt: skip
