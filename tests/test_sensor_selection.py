"""Choosing sensors by H, P and R."""

from functools import partial

import pytest
import references
import torch
from refusals import refuses

from torchrl_drbpn import select_sensors

DOUBLE = torch.float64
EYE = torch.eye(3)


def posterior(H, P, R, rows):
    """P+ in information form, P^-1 + H_S' R_SS^-1 H_S inverted: rows deleted, nothing masked."""
    if not rows:
        return P
    Hs, Rs = H[rows], R[rows][:, rows]
    return torch.linalg.inv(torch.linalg.inv(P) + Hs.T @ torch.linalg.solve(Rs, Hs))


def information(H, P, R, rows):
    """I(s; x_S) = 1/2 log det(I + R_SS^-1 H_S P H_S'), nats."""
    Hs, Rs = H[rows], R[rows][:, rows]
    inner = torch.eye(len(rows), dtype=DOUBLE) + torch.linalg.solve(Rs, Hs @ P @ Hs.T)
    return 0.5 * float(torch.linalg.slogdet(inner).logabsdet)


def criterion_value(criterion, cov):
    return float(torch.linalg.slogdet(cov).logabsdet if criterion == "D" else cov.trace())


def problem(seed, obs=7, state=4, full=False):
    """A random sensor model: H, P full, R diagonal or full."""
    g = torch.Generator().manual_seed(seed)
    H = torch.randn(obs, state, generator=g, dtype=DOUBLE)
    R = (
        references.spd(obs, g)
        if full
        else (0.05 + torch.rand(obs, generator=g, dtype=DOUBLE)).diag()
    )
    return H, references.spd(state, g), R


@pytest.mark.parametrize("full", [False, True], ids=["diagonal R", "full R"])
@pytest.mark.parametrize("criterion", ["D", "A"])
@pytest.mark.parametrize(("obs", "state", "seed"), [(7, 4, 0), (7, 4, 1), (7, 4, 2), (4, 6, 3)])
def test_every_pick_is_the_best_next_one_with_the_objective_and_information_of_update(
    obs, state, seed, criterion, full
):
    H, P, R = problem(seed, obs, state, full)
    chosen, rows = select_sensors(H, P, R, obs, criterion=criterion), []
    for k, pick in enumerate(chosen.indices.tolist()):
        values = {
            i: criterion_value(criterion, posterior(H, P, R, [*rows, i]))
            for i in range(obs)
            if i not in rows
        }
        assert pick == min(values, key=values.__getitem__)
        rows.append(pick)
        assert chosen.objective[k] == pytest.approx(values[pick], abs=1e-10)
        assert chosen.information[k] == pytest.approx(information(H, P, R, rows), abs=1e-10)


def test_the_trace_is_that_of_the_target():
    H, P, R = problem(2)
    C = torch.randn(2, 4, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    chosen = select_sensors(H, P, R, 3, criterion="A", target=C)
    for k in range(3):
        cov = posterior(H, P, R, chosen.indices[: k + 1].tolist())
        assert chosen.objective[k] == pytest.approx(float((C @ cov @ C.T).trace()), abs=1e-10)
    # A direction that is not in the target is worth nothing.
    only_first = select_sensors(
        EYE, torch.tensor([1.0, 9.0, 9.0]).diag(), torch.ones(3), 1, criterion="A", target=EYE[:1]
    )
    assert only_first.indices.tolist() == [0]


@pytest.mark.parametrize("criterion", ["D", "A"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_neither_the_order_of_the_sensors_nor_their_units_matter(seed, criterion):
    H, P, R = problem(seed, full=True)
    order = torch.randperm(7, generator=torch.Generator().manual_seed(seed))
    unit = torch.linspace(0.01, 50, 7, dtype=DOUBLE)
    ours = select_sensors(H, P, R, 5, criterion=criterion)
    H, R = unit[:, None] * H[order], unit[:, None] * R[order][:, order] * unit
    theirs = select_sensors(H, P, R, 5, criterion=criterion)
    assert torch.equal(ours.indices, order[theirs.indices])
    torch.testing.assert_close(ours.objective, theirs.objective)
    torch.testing.assert_close(ours.information, theirs.information)


def test_ties_go_to_the_lowest_index_in_spite_of_rounding():
    """Three copies of a rotated orthogonal frame: every gain is equal in exact arithmetic."""
    g = torch.Generator().manual_seed(1)
    frame = torch.linalg.qr(torch.randn(5, 5, generator=g, dtype=DOUBLE)).Q
    H = torch.cat([frame, -frame, frame])
    for criterion in ("D", "A"):
        chosen = select_sensors(H, torch.eye(5), torch.ones(15), 15, criterion=criterion)
        assert chosen.indices.tolist() == list(range(15))


@pytest.mark.parametrize("criterion", ["D", "A"])
def test_a_batch_is_a_loop(criterion):
    cases = [problem(seed, full=True) for seed in range(6)]
    H, P, R = (torch.stack(x).unflatten(0, (2, 3)) for x in zip(*cases, strict=True))
    whole = select_sensors(H, P, R, 4, criterion=criterion)
    for index, case in enumerate(cases):
        alone = select_sensors(*case, 4, criterion=criterion)
        at = divmod(index, 3)
        assert torch.equal(whole.indices[at], alone.indices)
        torch.testing.assert_close(whole.objective[at], alone.objective)
        torch.testing.assert_close(whole.information[at], alone.information)
    # One H and R for many covariances, as a filter has them; none at all.
    one = select_sensors(cases[0][0], P, cases[0][2], 2)
    assert one.indices.shape == (2, 3, 2)
    none = select_sensors(H, P, R, 0, criterion=criterion)
    assert [tuple(x.shape) for x in none] == [(2, 3, 0)] * 3


def test_variances_are_a_diagonal_matrix():
    H, P, R = problem(8)
    short, full = select_sensors(H, P, R.diagonal(), 7), select_sensors(H, P, R, 7)
    assert all(torch.equal(a, b) for a, b in zip(short, full, strict=True))


def test_float32_parameters_are_read_in_float64_and_need_no_gradient():
    H, P, R = (x.float().requires_grad_() for x in problem(9))
    chosen = select_sensors(H, P, R, 3)
    wide = select_sensors(H.double(), P.double(), R.double(), 3)
    assert chosen.objective.dtype == chosen.information.dtype == DOUBLE
    assert chosen.indices.dtype == torch.int64
    assert not chosen.objective.requires_grad
    assert torch.equal(chosen.objective, wide.objective)


def test_it_is_accurate_at_the_noise_floor():
    """R std 1e-2 against P std 1e2: gains of 9 nats and variances of 1e-4 beside 1e4."""
    H, P, _ = problem(2, 6, 6)
    P, R = 1e4 * P, torch.full((6,), 1e-4, dtype=DOUBLE)
    for criterion in ("D", "A"):
        chosen = select_sensors(H, P, R, 6, criterion=criterion)
        cov = posterior(H, P, R.diag(), chosen.indices.tolist())
        assert chosen.information[-1] == pytest.approx(
            information(H, P, R.diag(), chosen.indices.tolist()), rel=1e-9
        )
        assert chosen.objective[-1] == pytest.approx(criterion_value(criterion, cov), rel=1e-5)


test_bad_input_is_refused_in_one_line = refuses(
    ({"emission_matrix": torch.ones(3)}, r"`emission_matrix` must be H.*got \(3,\)"),
    ({"emission_matrix": EYE * torch.nan}, "`emission_matrix` must be H, finite"),
    ({"predicted_cov": torch.eye(2)}, r"`predicted_cov` must be of shape.*\(2, 2\)"),
    ({"predicted_cov": EYE.clone().fill_(1.0)}, "`predicted_cov` must be finite, symmetric"),
    ({"predicted_cov": EYE + EYE.roll(1, 0)}, "`predicted_cov` must be finite, symmetric"),
    ({"predicted_cov": EYE * torch.inf}, "`predicted_cov` must be finite, symmetric"),
    ({"emission_cov": torch.ones(2)}, r"`emission_cov` must be of shape.*3, 3.*got \(2, 2\)"),
    ({"emission_cov": torch.tensor([1.0, 0, 1])}, "`emission_cov` must be .*positive definite"),
    ({"emission_cov": -EYE}, "`emission_cov` must be .* positive definite"),
    ({"emission_matrix": torch.ones(2, 3, 3), "predicted_cov": EYE.expand(4, 3, 3)},
     r"must have batch shapes that broadcast, got \(2,\), \(4,\), \(\)"),
    ({"count": 4}, "`count` must be an int from 0 to 3, .*got 4"),
    ({"count": 1.0}, "`count` must be an int from 0"),
    ({"count": True}, "`count` must be an int from 0"),
    ({"criterion": "E"}, "`criterion` must be 'D' .* or 'A' .*got 'E'"),
    ({"target": EYE}, "`target` weighs the trace: it needs criterion='A'"),
    ({"criterion": "A", "target": torch.eye(2)}, "`target` must be finite and of shape"),
    ({"criterion": "A", "target": EYE.expand(2, 3, 3)},
     r"`target` must be .* the batch shape \(\) of the model or none, got \(2, 3, 3\)"),
    make=partial(select_sensors, emission_matrix=EYE, predicted_cov=EYE, emission_cov=EYE, count=1),
)  # fmt: skip
