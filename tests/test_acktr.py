"""ACKTR behind the recipe's one path; its steps are held to Fisher matrices in float64."""

import functools
import itertools
import shutil
import statistics

import pytest
import torch
from algorithms.acktr import ACKTR
from algorithms.kfac import KFAC, kronecker_factors, solve_kronecker
from ppo_drbpn import collect, train_rollout
from recipe_tools import assembled, assert_same_run, read_table, resume, run
from refusals import refuses
from torch import nn
from training.checkpoint import last_checkpoint, load_checkpoint
from training.ppo import add_advantages

SMOKE = ("algo=acktr", "belief=none", "experiment=[smoke,clean]", "algo.critic.steps=3")


@pytest.fixture(scope="module")
def acktr(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "smoke"
    assert run(folder, *SMOKE) == 0
    return folder


def rollout_of(*overrides):
    """A freshly assembled training and its first rollout, with advantages."""
    training, _ = assembled(*SMOKE, *overrides)
    assert isinstance(training.algorithm, ACKTR)
    data = collect(training)
    add_advantages(data, training.agent, training.gae)
    return training, data


def test_a_run_leaves_its_numbers_and_no_column_of_ppo(acktr):
    rows = read_table(acktr / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512]
    filled = {key for key, value in rows[-1].items() if value}
    assert {"return", "kl", "lr", "loss_objective", "loss_critic", "grad_norm"} < filled
    assert {"clip_fraction", "ess", "loss_model"}.isdisjoint(filled)
    assert len(read_table(acktr / "evaluation.csv")) == 4


def test_a_stopped_run_goes_on_to_the_last_bit(acktr, tmp_path):
    broken = shutil.copytree(acktr, tmp_path / "broken")
    last_checkpoint(broken).unlink()
    assert resume(broken) == 0
    assert_same_run(acktr, broken)
    state = load_checkpoint(last_checkpoint(broken))
    assert state["policy_optimizer"]["state"]
    assert state["critic_optimizer"]["state"]


def test_the_value_comes_nearer_to_its_targets():
    training, data = rollout_of("algo.critic.steps=25", "algo.critic.lr=0.1")

    def error():
        with torch.no_grad():
            value = training.agent.value(data)
        return (value - data.get("value_target")).square().mean().item() / 2

    before = error()
    row = training.algorithm.update(data, 1.0)
    assert row["loss_critic"] == pytest.approx(before, rel=1e-4)
    assert error() < 0.5 * before


def test_the_policy_climbs_its_objective_and_reports_its_divergence():
    training, data = rollout_of("algo.policy.momentum=0", "algo.policy.lr=0.2")
    advantage = data.get("advantage").squeeze(-1)
    advantage = (advantage - advantage.mean()) / advantage.std()
    old = training.agent.actor.get_dist(data.select("features"))
    row = training.algorithm.update(data, 1.0)
    with torch.no_grad():
        new = training.agent.actor.get_dist(data.select("features"))
        ratio = new.log_prob(data["action"]) - old.log_prob(data["action"])
    assert (ratio * advantage).mean() > 0
    kl = torch.distributions.kl_divergence(old, new).mean().item()
    assert row["kl"] == pytest.approx(kl, rel=1e-3)
    assert 0 < kl < 2 * 5e-3  # within reach of the trust region's 5e-3


@pytest.mark.parametrize(
    ("desired", "factor"), [(1e-9, 1 / 1.5), (1.0, 1.5)], ids=["too far", "too near"]
)
def test_the_step_size_follows_the_divergence(desired, factor):
    training, data = rollout_of(f"algo.desired_kl={desired}", "algo.policy.momentum=0")
    steps = [training.algorithm.update(data, 1.0)["lr"] for _ in range(2)]
    assert steps[0] == 0.03
    assert steps[1] == pytest.approx(0.03 * factor)


@pytest.mark.slow
def test_the_divergence_comes_to_the_one_asked_for():
    training, config = assembled(*SMOKE, "algo.policy.momentum=0.5")
    kls = [train_rollout(training, config)[0]["kl"] for _ in range(40)]
    # Not the mean: the rule answers a step that went far, it cannot foresee it. Half to twice
    # the 2e-3 asked for is where the rule leaves the step size as it is.
    assert 0.001 < statistics.median(kls[20:]) < 0.004


def test_the_generator_of_the_whole_process_is_left_alone():
    training, data = rollout_of()
    before = torch.get_rng_state()
    training.algorithm.update(data, 1.0)
    assert torch.equal(before, torch.get_rng_state())


N = 40
NUMBERS = {"lr": 1.0, "momentum": 0.0, "damping": 1e-12, "decay": 0.9, "max_kl": 1e9}


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def white_noise(generator, samples, components):
    """Noise whose second moments over the samples are the identity to the last digits."""
    q, _ = torch.linalg.qr(normal(generator, samples, components))
    return q * samples**0.5


def network(generator, *sizes):
    """A tanh network in float64; the last layer is linear."""
    layers = []
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        layers += [nn.Linear(inputs, outputs, dtype=torch.float64), nn.Tanh()]
        for p in layers[2 * i].parameters():
            p.data = 0.5 * normal(generator, *p.shape)
    return nn.Sequential(*layers[:-1])


def observe(optimizer, module, inputs, score):
    with optimizer.recording():
        output = module(inputs)
    optimizer.observe(output, score)
    return output


def test_the_curvature_of_every_layer_is_a_weighted_mean_of_what_was_observed(generator):
    module, decay = network(generator, 3, 4, 2), 0.7
    optimizer = KFAC(module, **{**NUMBERS, "decay": decay})
    seen = []
    for _ in range(3):
        inputs, score = normal(generator, N, 3), normal(generator, N, 2)
        observe(optimizer, module, inputs, score)
        # The score of a layer's output is the gradient by its bias, one sample at a time.
        biases = [module[0].bias, module[2].bias]
        grads = [
            torch.autograd.grad(module(x) @ s, biases) for x, s in zip(inputs, score, strict=True)
        ]
        hidden = torch.tanh(module[0](inputs)).detach()
        pairs = zip((inputs, hidden), zip(*grads, strict=True), strict=True)
        seen.append([kronecker_factors(a, torch.stack(g)) for a, g in pairs])
    weights = torch.tensor([decay**2, decay, 1.0], dtype=torch.float64)
    weights = weights / weights.sum()
    for layer, place in enumerate((0, 2)):
        state = optimizer.state[module[place].weight]
        for factor, key in enumerate("ag"):
            mean = sum(w * each[layer][factor] for w, each in zip(weights, seen, strict=True))
            torch.testing.assert_close(state[key] / (1 - decay**3), mean)


@pytest.mark.parametrize("samples", [N, 2], ids=["full rank", "deficient"])
def test_the_natural_gradient_solves_with_the_damped_kronecker_matrix(generator, samples):
    a, g = kronecker_factors(normal(generator, samples, 4), normal(generator, samples, 3))
    gradient, damping = normal(generator, 3, 5), 0.03
    solution = solve_kronecker(gradient, a, g, damping)
    matrix = torch.kron(a, g) + damping * torch.eye(15, dtype=torch.float64)
    expected = torch.linalg.solve(matrix, gradient.T.reshape(-1)).reshape(5, 3).T
    torch.testing.assert_close(solution, expected, rtol=1e-10, atol=1e-10)


def test_one_step_solves_linear_regression(generator):
    """With unit step size and no damping a natural-gradient step is Newton's."""
    layer = network(generator, 3, 2)[0]
    inputs, target = normal(generator, N, 3), normal(generator, N, 2)
    optimizer = KFAC(layer, **NUMBERS)
    output = observe(optimizer, layer, inputs, white_noise(generator, N, 2))
    ((output - target).square().sum(-1).mean() / 2).backward()
    optimizer.step()
    design = torch.cat([inputs, torch.ones(N, 1, dtype=torch.float64)], 1)
    best = torch.linalg.lstsq(design, target).solution.T
    torch.testing.assert_close(layer.weight, best[:, :-1], rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(layer.bias, best[:, -1], rtol=1e-8, atol=1e-8)


def test_the_step_of_a_parameter_of_constant_fisher_information_divides_by_it():
    log_std = nn.Parameter(torch.tensor([0.3, -1.0], dtype=torch.float64))
    module = nn.Module()
    module.log_std = log_std
    optimizer = KFAC(module, **{**NUMBERS, "damping": 0.5}, constant_fisher={log_std: 2.0})
    before = log_std.detach().clone()
    log_std.grad = torch.tensor([1.0, -3.0], dtype=torch.float64)
    optimizer.step()
    torch.testing.assert_close(before - log_std.detach(), log_std.grad / 2.5)


@pytest.mark.parametrize("max_kl", [1e-4, 0.3])
def test_a_long_step_is_shortened_to_the_divergence_asked_for(generator, max_kl):
    """The divergence of a linear Gaussian model is quadratic: here the prediction is the truth."""
    layer = network(generator, 3, 2)[0]
    root = torch.tensor([[0.5, 0.6], [0.0, 2.0]], dtype=torch.float64).inverse()  # of R^-1
    inputs = normal(generator, N, 3)
    optimizer = KFAC(layer, **{**NUMBERS, "lr": 100.0, "max_kl": max_kl})
    old = observe(optimizer, layer, inputs, white_noise(generator, N, 2) @ root)
    (old - normal(generator, N, 2)).square().mean().backward()
    predicted = optimizer.step()
    true = ((layer(inputs) - old) @ root.T).square().sum(-1).mean() / 2
    torch.testing.assert_close(predicted, torch.tensor(max_kl, dtype=torch.float64))
    torch.testing.assert_close(true, predicted, rtol=1e-6, atol=0.0)


def test_the_steps_are_averaged_by_momentum():
    parameter = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    module = nn.Module()
    module.parameter = parameter
    numbers = {**NUMBERS, "lr": 0.5, "momentum": 0.9}
    optimizer = KFAC(module, **numbers, constant_fisher={parameter: 1.0})
    parameter.grad = torch.ones(1, dtype=torch.float64)
    positions = [0.0]
    for _ in range(200):
        optimizer.step()
        positions.append(parameter.item())
    assert positions[1] == pytest.approx(-0.5 * 0.1)
    assert positions[2] - positions[1] == pytest.approx(-0.5 * 0.1 * 1.9)
    assert positions[-1] - positions[-2] == pytest.approx(-0.5)


def test_a_step_before_any_curvature_is_refused(generator):
    layer = network(generator, 3, 2)[0]
    layer(normal(generator, N, 3)).sum().backward()
    with pytest.raises(RuntimeError, match="`step` needs a curvature: call `observe` first"):
        KFAC(layer, **NUMBERS).step()


LINEAR = "`module` must hold linear layers.*got"
test_other_layers_are_refused_by_name = refuses(
    ({"module": nn.Sequential(nn.Linear(2, 2), nn.LayerNorm(2))}, f"{LINEAR} 1.weight, 1.bias"),
    ({"module": nn.Linear(2, 2, bias=False)}, f"{LINEAR} a layer without bias"),
    make=functools.partial(KFAC, **NUMBERS),
)
