"""`BeliefModelLoss` meets the suite of losses, and is minus the log-likelihood, each once."""

import pytest
import torch
from refusals import refuses
from suites import LossSuite
from tensordict import TensorDict

from torchrl_drbpn import BeliefModelLoss

OBS, BATCH, TIME = 4, 3, 5
MASK = r"`observed` must be bool of shape \(\*batch, obs\)"


def make_data(dtype=torch.float32, seed=0):
    """Log-likelihoods and masks of a rollout, with its next step; done inside rows."""
    g = torch.Generator().manual_seed(seed)
    shape = (BATCH, TIME)

    def part():
        observed = torch.rand(*shape, OBS, generator=g) < 0.5
        ll = torch.randn(*shape, generator=g, dtype=dtype)
        ll = torch.where(observed.any(-1), ll, 0.0)
        return {"observed": observed, "belief": {"log_likelihood": ll}}

    done = torch.zeros(*shape, 1, dtype=torch.bool)
    done[0, 2] = done[1, 0] = done[2, 4] = True
    final = torch.zeros(*shape, 1, dtype=torch.bool)
    final[:, -1] = True
    data = TensorDict({**part(), "next": {**part(), "done": done}, "final": final}, shape)
    data["belief", "log_likelihood"].requires_grad_()
    return data


def counted(data):
    """Sum of log-likelihoods, entries and steps that count, one step at a time."""
    total, entries, steps = torch.zeros((), dtype=torch.float64), 0, 0
    for b in range(BATCH):
        for t in range(TIME):
            steps += 1
            entries += int(data["observed"][b, t].sum())
            total = total + data["belief", "log_likelihood"][b, t]
            if data["next", "done"][b, t] or data["final"][b, t]:
                steps += 1
                entries += int(data["next", "observed"][b, t].sum())
                total = total + data["next", "belief", "log_likelihood"][b, t]
    return total, entries, steps


class TestSuite(LossSuite):
    has_networks = False

    def make_loss(self, **kwargs):
        return BeliefModelLoss(**kwargs)

    def make_loss_data(self, dtype=torch.float32):
        return make_data(dtype).detach()

    test_parameters_can_be_reset = None  # there are none


@pytest.mark.parametrize("normalize", ["entry", "step"])
def test_it_is_minus_the_sum_over_what_arrived(normalize):
    data = make_data(torch.float64)
    assert data["next", "done"][2, -1]  # a step that is done and final counts once
    total, entries, steps = counted(data)
    out = BeliefModelLoss(normalize=normalize)(data)
    expected = -total / (entries if normalize == "entry" else steps)
    torch.testing.assert_close(out["loss_model"], expected, rtol=1e-12, atol=0)
    # the metric is per entry whatever the loss is divided by, and carries no gradient
    torch.testing.assert_close(out["log_likelihood"], total / entries, rtol=1e-12, atol=0)
    assert out["loss_model"].requires_grad
    assert not out["log_likelihood"].requires_grad
    for reduction in ("sum", "none"):  # in nats
        value = BeliefModelLoss(normalize=normalize, reduction=reduction)(data)["loss_model"]
        torch.testing.assert_close(value.sum(), -total, rtol=1e-12, atol=1e-12)


def test_without_next_likelihoods_the_root_steps_count_alone():
    data = make_data(torch.float64).select(("belief", "log_likelihood"), "observed")
    value = BeliefModelLoss()(data)["loss_model"]
    expected = -data["belief", "log_likelihood"].sum() / data["observed"].sum()
    torch.testing.assert_close(value, expected)


@pytest.mark.parametrize("normalize", ["entry", "step"])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_nothing_observed_at_all_is_a_finite_zero(normalize, reduction):
    ll = torch.zeros(2, 3, requires_grad=True)
    nothing = torch.zeros(2, 3, OBS, dtype=torch.bool)
    data = TensorDict({("belief", "log_likelihood"): ll * 1.0, "observed": nothing}, [2, 3])
    out = BeliefModelLoss(normalize=normalize, reduction=reduction)(data)
    assert out["loss_model"] == 0
    assert out["log_likelihood"] == 0
    out["loss_model"].backward()
    assert ll.grad.isfinite().all()


def test_steps_that_torchrl_marks_invalid_do_not_count():
    data = make_data(torch.float64)
    mask = torch.ones(BATCH, TIME, 1, dtype=torch.bool)
    mask[:, 3:] = False
    cut = BeliefModelLoss()(data[:, :3])["loss_model"]
    data["collector", "mask"] = mask
    data["belief", "log_likelihood"].data[:, 3:] = torch.nan  # padding may hold anything
    torch.testing.assert_close(BeliefModelLoss()(data)["loss_model"], cut)


def test_an_end_that_a_sampler_of_single_steps_wrote_is_not_believed():
    data = make_data(torch.float64)
    data["next", "terminated"] = torch.zeros(BATCH, TIME, 1, dtype=torch.bool)
    data["next", "terminated"][0, 2] = True
    place = torch.arange(BATCH * TIME).reshape(BATCH, TIME, 1)
    by_rows = data.copy().set("index", place[:, :1].expand(BATCH, TIME, 1))
    by_steps = data.copy().set("index", place)
    loss = BeliefModelLoss()
    done, final = data["next", "done"].squeeze(-1), data["final"].squeeze(-1)
    assert torch.equal(loss.last_steps(by_rows), done | final)
    assert torch.equal(loss.last_steps(by_steps), data["next", "terminated"].squeeze(-1) | final)


def of(change):
    """Return the use of the loss on data that are changed."""
    return lambda: BeliefModelLoss()(change(make_data()))


UNRUN = "not in .*: run the belief module on it"
test_bad_use_is_one_clear_line = refuses(
    ({"normalize": "batch"}, "`normalize` must be 'entry' or 'step', got 'b"),
    ({"reduction": "max"}, "`reduction` must be 'none', 'mean' or 'sum'"),
    (of(lambda d: d.exclude("observed")), KeyError, UNRUN),
    (of(lambda d: d.exclude("belief")), KeyError, UNRUN),
    (of(lambda d: d.set("observed", d["observed"].float())), MASK),
    (of(lambda d: d.set("observed", d["observed"][..., 0])), MASK),
    make=BeliefModelLoss,
)
