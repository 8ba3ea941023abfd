"""PPO's terms of two tanh networks in C, held to PyTorch's operations.

Specified here:

- objective, error, metrics and every gradient equal PyTorch's, to the rounding of the dtype, for
  networks of one to four layers, widths that fill no whole vector, one frame and many, every
  distance, and a scale that its floor holds up;
- tanh keeps its digits from 1e-30 to where it is 1, of either sign, and a NaN stays one;
- one output's gradient alone, and the same graph twice;
- what it does not take, it names; `DRBPNLoss` then runs PyTorch's operations, and runs the C code
  where it can.
"""

from __future__ import annotations

import itertools

import pytest
import torch
from agents import Agent, make_agent
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from test_drbpn_loss import gradients, make_belief_agent, make_data, make_ppo
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator, set_recurrent_mode

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss
from torchrl_drbpn.functional import compiled
from torchrl_drbpn.functional.heads import (
    PreparedPolicy,
    clipped_heads,
    heads_refusal,
    policy_refusal,
)
from torchrl_drbpn.objectives import _clipped

pytestmark = pytest.mark.skipif(
    "there is no C compiler" in (compiled.native_error() or ""), reason="no C compiler here"
)
LOW, HIGH = -0.2, 0.25


class Problem:
    """Two networks, and frames whose ratios lie on both sides of the clipping."""

    def __init__(self, shape, features, actions, hidden, dtype=torch.float64, log_scale=0.3):
        self.dtype, self.generator = dtype, torch.Generator().manual_seed(0)
        self.actor = self.network([features, *hidden, actions])
        self.critic = self.network([features, *hidden[::-1], 1])
        self.features = self.draw(*shape, features).requires_grad_()
        self.log_scale = (log_scale * self.draw(actions)).requires_grad_()
        with torch.no_grad():
            loc, scale = run(self.actor, self.features), self.log_scale.exp()
            self.action = loc + scale * self.draw(*shape, actions)
            density = torch.distributions.Normal(loc, scale).log_prob(self.action).sum(-1)
        self.old = density + 0.3 * self.draw(*shape)
        self.advantage, self.target = self.draw(*shape), self.draw(*shape)

    def draw(self, *shape):
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64).to(self.dtype)

    def network(self, sizes):
        out = []
        for inputs, outputs in itertools.pairwise(sizes):
            out += [self.draw(outputs, inputs) / inputs**0.5, 0.1 * self.draw(outputs)]
        return [value.requires_grad_() for value in out]

    @property
    def given(self):
        return (
            self.features, self.action, self.old, self.advantage, self.target, self.log_scale,
        )  # fmt: skip

    @property
    def differentiable(self):
        return [self.features, self.log_scale, *self.actor, *self.critic]

    def native(self, kind="l1", floor=1e-4):
        assert heads_refusal(*self.given, self.actor, self.critic) is None
        terms = clipped_heads(
            *self.given, self.actor, self.critic, low=LOW, high=HIGH, scale_floor=floor, kind=kind
        )
        assert terms is not None
        return terms

    def pytorch(self, kind="l1", floor=1e-4):
        """The same in the plainest operations."""
        scale = self.log_scale.exp().clamp_min(floor)
        policy = torch.distributions.Normal(run(self.actor, self.features), scale)
        log_ratio = policy.log_prob(self.action).sum(-1) - self.old
        ratio, clipped = log_ratio.exp(), log_ratio.clamp(LOW, HIGH)
        gain = torch.minimum(ratio * self.advantage, clipped.exp() * self.advantage)
        distance = {
            "l1": nn.functional.l1_loss,
            "l2": nn.functional.mse_loss,
            "smooth_l1": nn.functional.smooth_l1_loss,
        }[kind]
        error = distance(run(self.critic, self.features).squeeze(-1), self.target)
        size = ratio.sum(0).square() / ratio.square().sum(0) / len(ratio)
        outside = (log_ratio != clipped).to(self.dtype).mean()
        metrics = (outside, -log_ratio.mean(), ratio.max(), ratio.mean(), size)
        return (-gain.mean(), error, *(value.detach() for value in metrics))


def run(network, x):
    for i in range(0, len(network), 2):
        x = nn.functional.linear(x if i == 0 else x.tanh(), network[i], network[i + 1])
    return x


def assert_alike(problem, kind="l1", floor=1e-4):
    tight = problem.dtype is torch.float64
    close = {"rtol": 1e-10, "atol": 1e-13} if tight else {"rtol": 1e-5, "atol": 1e-6}
    received, expected = problem.native(kind, floor), problem.pytorch(kind, floor)
    for name, a, b in zip(received._fields, received, expected, strict=True):
        torch.testing.assert_close(a, b, **close, msg=lambda m, name=name: f"{name}: {m}")
        assert a.requires_grad == (name in ("objective", "error")), name
    for first in (0, 1):
        pairs = (
            torch.autograd.grad(
                0.5 * out[first],
                problem.differentiable,
                retain_graph=True,
                allow_unused=True,
                materialize_grads=True,
            )
            for out in (received, expected)
        )
        for a, b in zip(*pairs, strict=True):
            assert (a is None) == (b is None)  # the other head's parameters are left alone
            if a is not None:
                torch.testing.assert_close(a, b, rtol=close["rtol"], atol=close["atol"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("shape", "features", "actions", "hidden"),
    [
        ((16, 16), 17, 6, (64, 64)),
        ((4, 16), 11, 3, (64, 32)),
        ((7,), 3, 2, (5,)),
        ((1, 1), 1, 1, ()),
        ((2, 3, 5), 40, 17, (33, 8, 100)),
    ],
    ids=str,
)
def test_every_size_equals_pytorch(shape, features, actions, hidden, dtype):
    problem = Problem(shape, features, actions, hidden, dtype)
    if len(problem.old.flatten()) > 1:
        assert 0 < problem.native().clip_fraction < 1
    assert_alike(problem)


@pytest.mark.parametrize("kind", ["l1", "l2", "smooth_l1"])
def test_every_distance_equals_pytorch(kind):
    problem = Problem((6, 4), 5, 2, (9,))
    problem.target = 2 * problem.target  # errors on both sides of 1
    assert_alike(problem, kind)


def test_a_scale_at_its_floor_has_no_gradient():
    problem = Problem((6, 4), 5, 3, (9,), log_scale=1.0)
    floor = problem.log_scale.exp().sort().values[1].item() * 1.01  # holds two of three up
    assert_alike(problem, floor=floor)
    (by_scale,) = torch.autograd.grad(problem.native(floor=floor).objective, problem.log_scale)
    assert (by_scale != 0).sum() == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_tanh_keeps_its_digits(dtype):
    x = torch.logspace(-30, 2, 4001, dtype=torch.float64)
    x = torch.cat([x, -x, torch.zeros(1), torch.linspace(-25, 25, 2001)]).to(dtype)
    one, zero = torch.ones(1, 1, dtype=dtype), torch.zeros(1, dtype=dtype)
    # Where the target is 0, the absolute error of one frame is |tanh(x)|, its gradient the sign.
    linear = [one, zero, one.clone(), zero.clone()]
    nothing = torch.zeros(1, dtype=dtype)
    found = torch.stack(
        [
            clipped_heads(
                value.view(1, 1), nothing.view(1, 1), nothing, nothing, nothing, zero, linear,
                linear, low=LOW, high=HIGH, scale_floor=1e-4, kind="l1",
            ).error
            for value in x
        ]
    )  # fmt: skip
    expected = x.double().tanh().abs()
    digits = torch.finfo(dtype).eps
    assert ((found.double() - expected).abs() <= 4 * digits * expected).all()


def test_the_sign_of_tanh_is_that_of_its_input():
    problem = Problem((8, 8), 5, 2, (9,))
    with torch.no_grad():
        problem.features.mul_(10)
    assert_alike(problem)


def test_the_same_graph_twice_and_one_output_alone():
    problem = Problem((6, 4), 5, 2, (9,))
    out = problem.native()
    total = out.objective + 0.7 * out.error
    once, again = (
        torch.autograd.grad(total, problem.differentiable, retain_graph=True) for _ in range(2)
    )
    for a, b in zip(once, again, strict=True):
        assert torch.equal(a, b)


def test_features_without_a_gradient():
    problem = Problem((6, 4), 5, 2, (9,))
    with_gradient = torch.autograd.grad(problem.native().objective, problem.actor)
    problem.features = problem.features.detach()
    without = torch.autograd.grad(problem.native().objective, problem.actor)
    assert all(map(torch.equal, with_gradient, without))


def test_what_it_does_not_take_it_names():
    problem = Problem((6, 4), 5, 2, (9,))
    actor, critic, given = problem.actor, problem.critic, problem.given
    assert heads_refusal(*given, actor, critic) is None
    assert "dtypes" in heads_refusal(*given[:-1], given[-1].float(), actor, critic)
    turned = given[0].transpose(0, 1).contiguous().transpose(0, 1)
    assert "contiguous" in heads_refusal(turned, *given[1:], actor, critic)
    assert "CPU" in heads_refusal(*given[:-1], given[-1].to("meta"), actor, critic)
    assert "layers" in heads_refusal(*given, actor * 5, critic)
    half = [value.half() for value in (*given, *actor, *critic)]
    assert "float16" in heads_refusal(*half[:6], half[6:10], half[10:])
    with torch.autocast("cpu", torch.bfloat16):
        assert "autocast" in heads_refusal(*given, actor, critic)


def other_features(p):
    p.features = p.draw(6, 4, 7)


def narrow_features(p):
    p.features = p.draw(6, 4, 3)


def other_actions(p):
    p.action = p.draw(6, 4, 3)


def no_single_value(p):
    p.critic = p.network([5, 9, 2])


def other_locations(p):
    p.actor = p.network([5, 9, 3])


def broken_chain(p):
    p.actor = [*p.network([5, 9]), *p.network([8, 2])]


def short_bias(p):
    p.actor[1] = p.actor[1][:-1].contiguous()


def column(p):
    p.old = p.old.unsqueeze(-1)


def other_frames(p):
    p.target = p.draw(6, 5)


def wide_scale(p):
    p.log_scale = p.draw(3)


@pytest.mark.parametrize(
    "spoil",
    [
        other_features, narrow_features, other_actions, no_single_value, other_locations,
        broken_chain, short_bias, column, other_frames, wide_scale,
    ],
    ids=lambda f: f.__name__,
)  # fmt: skip
def test_shapes_that_do_not_fit_never_reach_c(spoil):
    problem = Problem((6, 4), 5, 2, (9,))
    spoil(problem)
    assert "fit" in (reason := heads_refusal(*problem.given, problem.actor, problem.critic)) or (
        "outputs" in reason
    )
    terms = clipped_heads(
        *problem.given, problem.actor, problem.critic, low=LOW, high=HIGH, scale_floor=1e-4,
        kind="l1",
    )  # fmt: skip
    assert terms is None


@pytest.mark.parametrize("kind", ["l1", "l2", "smooth_l1"])
@pytest.mark.parametrize("where", ["features", "advantage", "old", "target"])
def test_a_nan_reaches_value_and_gradient_as_in_pytorch(where, kind):
    problem = Problem((6, 4), 5, 2, (9,))
    with torch.no_grad():
        getattr(problem, where)[0, 1] = torch.nan
    # the plainest operations take the gradient of a minimum of two NaN for NaN, as ours do
    received, expected = problem.native(kind), problem.pytorch(kind)
    for name, a, b in zip(received._fields, received, expected, strict=True):
        assert a.isnan().any() == b.isnan().any(), name
    for first in (0, 1):
        a, b = (
            torch.autograd.grad(
                out[first], problem.differentiable, retain_graph=True, allow_unused=True
            )
            for out in (received, expected)
        )
        for x, y in zip(a, b, strict=True):
            assert (x is None) == (y is None)
            assert x is None or x.isnan().any() == y.isnan().any(), (where, first)


def test_effective_sample_sizes_of_ratios_beyond_the_numbers():
    problem = Problem((6, 4), 5, 2, (9,), torch.float32)
    problem.old = problem.old + torch.tensor([120.0, 0.0, -120.0, 0.0])
    sizes = problem.native().sample_size
    assert ((sizes > 0) & (sizes <= 1)).all()


# -------------------------------------------------------------------------------- decisions
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("hidden", [(64, 64), (9,), ()], ids=str)
def test_decisions_are_pytorchs(dtype, hidden):
    problem = Problem((16,), 17, 6, hidden, dtype)
    scale = problem.log_scale.detach().exp()
    policy = PreparedPolicy(problem.actor, scale, 16)
    close = {"rtol": 1e-12, "atol": 1e-12}
    close = close if dtype is torch.float64 else {"rtol": 1e-5, "atol": 1e-5}
    for _ in range(3):  # what is laid out once serves again
        features, noise = problem.draw(16, 17), problem.draw(16, 6)
        loc, action, log_prob = policy(features, noise)
        normal = torch.distributions.Normal(run(problem.actor, features).detach(), scale)
        torch.testing.assert_close(loc, normal.loc, **close)
        torch.testing.assert_close(action, normal.loc + scale * noise, **close)
        torch.testing.assert_close(log_prob, normal.log_prob(action).sum(-1), **close)
        assert not loc.requires_grad


def test_a_decision_has_the_loss_own_log_probability():
    """A ratio of the first epoch is 1 as closely as the numbers allow."""
    problem = Problem((16,), 17, 6, (64, 64), torch.float32)
    policy = PreparedPolicy(problem.actor, problem.log_scale.detach().exp(), 16)
    _, problem.action, problem.old = policy(problem.features.detach(), problem.draw(16, 6))
    assert abs(problem.native().max_ratio - 1) < 1e-5


def test_what_a_decision_does_not_take_is_an_error():
    problem = Problem((16,), 5, 2, (9,))
    scale = problem.log_scale.detach().exp()
    assert "outputs" in policy_refusal(problem.actor, problem.draw(16, 5), scale[:1])
    with pytest.raises(ValueError, match="another number of outputs"):
        PreparedPolicy(problem.actor, scale[:1], 16)
    policy = PreparedPolicy(problem.actor, scale, 16)
    for features, noise in (
        (problem.draw(16, 6), problem.draw(16, 2)),
        (problem.draw(15, 5), problem.draw(15, 2)),
        (problem.draw(16, 5).float(), problem.draw(16, 2)),
        (problem.draw(5, 16).t(), problem.draw(16, 2)),
        (problem.draw(16, 5), problem.draw(16, 3)),
    ):
        with pytest.raises(ValueError, match="`features` and `noise` must be"):
            policy(features, noise)


def test_a_change_in_place_is_seen_and_other_storage_is_no_danger():
    problem = Problem((16,), 5, 2, (9,))
    policy = PreparedPolicy(problem.actor, problem.log_scale.detach().exp(), 16)
    features, noise = problem.draw(16, 5), problem.draw(16, 2)
    with torch.no_grad():
        problem.actor[0].mul_(2)
    loc, _, _ = policy(features, noise)
    torch.testing.assert_close(loc, run(problem.actor, features).detach())
    for layer in problem.actor:
        layer.data = torch.full_like(layer, torch.nan)
    again, _, _ = policy(features, noise)
    assert torch.equal(again, loc)


# -------------------------------------------------------------------------------- in the loss
def tanh_agent(dtype=torch.float64, mapping="exp", features="features") -> Agent:
    """A belief filter and heads of the recipe's kind."""
    belief = make_belief_agent(dtype).belief
    agent = make_agent(belief, belief.feature_dim, dtype=dtype)
    with torch.random.fork_rng():
        torch.manual_seed(3)

        def network(outputs):
            layers = (nn.Linear(belief.feature_dim, 7), nn.Tanh(), nn.Linear(7, outputs))
            return nn.Sequential(*layers).to(dtype)

        scale = AddStateIndependentNormalScale(1, scale_mapping=mapping).to(dtype)
        policy = nn.Sequential(network(1), scale)
        critic = network(1)
    agent.actor = ProbabilisticActor(
        TensorDictModule(policy, ["features"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    agent.critic = ValueOperator(critic, in_keys=[features])
    return agent


def terms(agent, data):
    ppo = make_ppo(
        agent, entropy_bonus=False, log_explained_variance=False, functional=False,
        loss_critic_type="smooth_l1", critic_coeff=0.7,
    )  # fmt: skip
    heads = _clipped.plain_heads(ppo, data)
    assert heads is not None
    return ppo, _clipped.plain_terms(ppo, heads, data, {})


@pytest.fixture
def called(monkeypatch):
    """How often the C code ran."""
    calls = []

    def counted(*args, **kwargs):
        calls.append(1)
        return clipped_heads(*args, **kwargs)

    monkeypatch.setattr(_clipped, "clipped_heads", counted)
    return calls


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_loss_of_tanh_heads_is_that_of_clip_ppo(called, dtype):
    agent, data = tanh_agent(dtype), make_data(dtype)
    with set_recurrent_mode(True):
        agent.belief(data)
    ppo, received = terms(agent, data)
    expected = ppo(data)
    assert called == [1]
    assert set(received) == set(expected.keys())
    tight = {"rtol": 1e-10, "atol": 1e-12}
    tight = tight if dtype is torch.float64 else {"rtol": 1e-4, "atol": 1e-5}
    for key, value in expected.items():
        torch.testing.assert_close(received[key], value, **tight, msg=key)
        if key.startswith("loss"):
            pairs = zip(gradients(agent, received[key]), gradients(agent, value), strict=True)
            for a, b in pairs:
                torch.testing.assert_close(a, b, **tight)


def hook(agent):
    agent.critic.module[0].register_forward_hook(lambda *_: None)


def other_activation(agent):
    agent.critic.module[1] = nn.ReLU()


def no_bias(agent):
    agent.actor.module[0].module[0][2].bias = None


def own_features(agent):
    agent.critic.in_keys = [("belief", "mean")]


def outer_hook(agent):
    agent.critic.register_forward_hook(lambda *_: None)


def own_forward(agent):
    layer = agent.critic.module[0]
    layer.forward = lambda x: 2 * nn.functional.linear(x, layer.weight, layer.bias)


def spectral(agent):
    nn.utils.parametrizations.spectral_norm(agent.critic.module[0])


@pytest.mark.parametrize(
    "change",
    [hook, other_activation, no_bias, own_features, own_forward, spectral],
    ids=lambda f: f.__name__,
)
def test_other_heads_run_in_pytorch(called, change):
    agent, data = tanh_agent(), make_data()
    with set_recurrent_mode(True):
        agent.belief(data)
    data["belief", "mean"] = data["belief", "mean"].clone()
    change(agent)
    ppo, received = terms(agent, data)
    assert called == []
    if change is not spectral:  # its power iteration goes on at every call
        for key, value in ppo(data).items():
            torch.testing.assert_close(received[key], value, rtol=1e-10, atol=1e-12, msg=key)


def test_a_hook_on_a_whole_head_calls_the_held_loss():
    agent, data = tanh_agent(), make_data()
    outer_hook(agent)
    ppo = make_ppo(agent, entropy_bonus=False, log_explained_variance=False, functional=False)
    assert _clipped.plain_heads(ppo, data) is None


@pytest.mark.parametrize("absent", ["action_log_prob", "value_target"])
def test_what_is_missing_is_named_by_the_held_loss(absent):
    agent, data = tanh_agent(), make_data()
    ppo = make_ppo(agent, entropy_bonus=False, log_explained_variance=False, functional=False)
    loss = DRBPNLoss(agent.belief, ppo, BeliefModelLoss(), functional=False)
    with pytest.raises(KeyError, match=absent):
        loss(data.exclude(absent))


def test_heads_that_do_not_fit_raise_pytorchs_error():
    agent, data = tanh_agent(), make_data()
    with set_recurrent_mode(True):
        agent.belief(data)
    data["features"] = torch.cat([data["features"], data["features"]], -1)
    ppo = make_ppo(agent, entropy_bonus=False, log_explained_variance=False, functional=False)
    heads = _clipped.plain_heads(ppo, data)
    with pytest.raises(RuntimeError, match="mat1 and mat2 shapes"):
        _clipped.plain_terms(ppo, heads, data, {})


def test_another_mapping_of_the_scale_runs_in_pytorch(called):
    agent, data = tanh_agent(mapping="softplus"), make_data()
    with set_recurrent_mode(True):
        agent.belief(data)
    terms(agent, data)
    assert called == []
