"""What `DRBPNLoss` is held to: a loss's requirements, and eq. (13) [DRBPN] from one filter pass."""

import functools

import pytest
import torch
from filter_problems import built, by_hand, recording
from refusals import refuses
from small_agents import ACTION, OBS, TIME, add_advantages, collect, make_agent, make_filter
from suites import LossSuite
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.modules import GRUModule, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss

from torchrl_drbpn import BeliefFilterModule, BeliefModelLoss, DRBPNLoss, MaskedObservationNorm

PPO_TERMS = ("loss_objective", "loss_critic", "loss_entropy")
filters = pytest.mark.parametrize("covariance", ["constant", "propagated"])


def make_belief_agent(dtype=torch.float64, covariance="constant"):
    belief = BeliefFilterModule(make_filter(OBS, ACTION, dtype, covariance=covariance))
    return make_agent(belief, belief.feature_dim, dtype=dtype)


@functools.cache
def rollout(*args):
    """Fresh data of `make_belief_agent`, with advantages; cloned by `make_data`."""
    agent = make_belief_agent(*args)
    dtype = next(agent.belief.parameters()).dtype
    return add_advantages(agent, collect(agent, dtype=dtype))


def make_data(*args):
    data = rollout(*args).clone()
    final = torch.zeros(*data.shape, 1, dtype=torch.bool)
    final[:, -1] = True
    return data.set("final", final)


def make_ppo(agent, **kwargs):
    kwargs = {"normalize_advantage": True, **kwargs}
    return ClipPPOLoss(agent.actor, agent.critic, **kwargs)


def make_loss(agent=None, *, ppo=None, **kwargs):
    agent = make_belief_agent() if agent is None else agent
    model = kwargs.pop("model", None) or BeliefModelLoss()
    return DRBPNLoss(agent.belief, make_ppo(agent, **(ppo or {})), model, **kwargs)


def as_dtype(data, dtype):
    return data.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)


def cut(data, length):
    """Sequences cut from the rows of a rollout, [rows * time / length, length]."""
    return data.reshape(-1).reshape(-1, length)


class TestSuite(LossSuite):
    def make_loss(self, **kwargs):
        # analytic entropy: nothing is sampled in the loss
        return make_loss(make_belief_agent(torch.float32), **kwargs)

    def make_loss_data(self, dtype=torch.float32):
        return as_dtype(make_data(torch.float32), dtype)


class TestSuiteWithoutAModel(LossSuite):
    """A GRU in the filter's place."""

    # TorchRL's GRU does not compile.
    test_compiled_without_a_break_it_is_the_same = None

    def make_loss(self, **kwargs):
        return make_gru_loss()[1]

    def make_loss_data(self, dtype=torch.float32):
        agent, _ = make_gru_loss()
        return as_dtype(add_advantages(agent, collect(agent, dtype=torch.float32)), dtype)


def make_gru_loss(model=None):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        gru = GRUModule(input_size=OBS, hidden_size=6, in_key="observation", out_key="features")
    agent = make_agent(gru, 6, dtype=torch.float32)
    return agent, DRBPNLoss(gru, make_ppo(agent), model)


def test_one_pass_over_time_and_one_step_for_the_last_observations():
    agent = make_belief_agent()
    loss, data, calls = make_loss(agent), make_data(), []
    agent.belief.filter.register_forward_hook(
        lambda module, args, out: calls.append(tuple(out.log_likelihood.shape))
    )
    loss(data)
    ends = (data["next", "done"] | data["final"]).sum().item()
    assert calls == [tuple(data.shape), (ends, 1)]
    # a rollout without an end adds nothing, and no empty batch is filtered
    data = data[:, :1].exclude("final")
    data["next", "done"].fill_(False)
    calls.clear()
    out = make_loss(agent, model=BeliefModelLoss(reduction="none"))(data)
    assert calls == [tuple(data.shape)]
    with set_recurrent_mode(True):
        agent.belief(data)
    torch.testing.assert_close(out["loss_model"], -data["belief", "log_likelihood"])


@built
@filters
@pytest.mark.parametrize("functional", [True, False])
def test_compiled_it_holds_both_passes_of_the_native_filter(functional, covariance):
    data, graphs = make_data(torch.float64, covariance), []

    torch._dynamo.reset()
    agent = make_belief_agent(torch.float64, covariance)
    torch.compile(make_loss(agent, ppo={"functional": functional}), backend=recording(graphs))(data)
    operator = torch.ops.torchrl_drbpn.filter_rows
    assert [n.target for graph in graphs for n in graph.graph.nodes].count(operator) == 2


def reference(agent, data):
    """ClipPPOLoss after a pass of the belief module, and its gradients by all parameters."""
    beliefs = data.copy()
    with set_recurrent_mode(True):
        agent.belief(beliefs)
    out = make_ppo(agent)(beliefs)
    return out, gradients(agent, sum(out[key] for key in PPO_TERMS))


def gradients(agent, total):
    parts = (agent.belief, agent.actor, agent.critic)
    parameters = [p for part in parts for p in part.parameters()]
    return torch.autograd.grad(
        total, parameters, allow_unused=True, materialize_grads=True, retain_graph=True
    )


def summed(out):
    return sum(value for key, value in out.items() if key.startswith("loss"))


def assert_identical(received, expected):
    for key, value in expected.items():
        assert torch.equal(received[key], value), key


@pytest.mark.parametrize("model_coeff", [0.0, 3.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [TIME, 6])
def test_the_model_term_leaves_the_ppo_terms_as_they_were_and_with_coeff_0_all(
    dtype, length, model_coeff
):
    agent, data = make_belief_agent(dtype), cut(make_data(dtype), length)
    expected, expected_grads = reference(agent, data)
    out = make_loss(agent, model_coeff=model_coeff)(data)
    assert_identical(out, expected)
    ppo = sum(out[key] for key in PPO_TERMS)
    if model_coeff == 0:
        assert out["loss_model"] == 0
        ppo = summed(out)
    assert all(map(torch.equal, gradients(agent, ppo), expected_grads))
    assert any(grad.any() for grad in expected_grads[: len(list(agent.belief.parameters()))])


def test_the_model_term_comes_out_weighted_and_its_metric_does_not():
    agent, data = make_belief_agent(), make_data()
    loss = make_loss(agent, model_coeff=1.0)
    out = loss(data)
    assert torch.equal(out["log_likelihood"], -out["loss_model"].detach())
    loss.model_coeff = 0.3
    changed = loss(data)
    torch.testing.assert_close(changed["loss_model"], 0.3 * out["loss_model"])
    assert torch.equal(changed["log_likelihood"], out["log_likelihood"])
    assert loss.state_dict()["model_coeff"] == pytest.approx(0.3)


def test_a_detached_belief_learns_from_the_model_alone():
    agent, data = make_belief_agent(), make_data()
    count = len(list(agent.belief.parameters()))
    attached = make_loss(agent)(data)
    detached = make_loss(agent, detach_belief=True)(data)
    assert_identical(detached, attached)
    ppo = gradients(agent, sum(detached[key] for key in PPO_TERMS))
    assert not any(grad.any() for grad in ppo[:count])
    # the heads learn as before, and so does the filter from the model
    before = gradients(agent, sum(attached[key] for key in PPO_TERMS))
    assert all(map(torch.equal, ppo[count:], before[count:]))
    from_model = [gradients(agent, out["loss_model"]) for out in (detached, attached)]
    assert all(map(torch.equal, *from_model))


def counted(agent, data):
    """Log-likelihood of every received observation, and entries, from the row-deleting oracle."""
    model = agent.belief.filter
    total, entries = torch.zeros((), dtype=torch.float64), 0
    for row in data.unbind(0):
        frames = []
        for t, frame in enumerate(row.unbind(0)):
            frames += [frame] if t == 0 or frame["is_init"] else []
            frames.append(frame["next"])
        names = ("previous_action", "observation", "observed", "is_init")
        action, x, seen, start = (torch.stack([f[n] for f in frames])[None] for n in names)
        stored = row[:1]["recurrent"]
        inputs = (action.double(), x, seen, start.squeeze(-1))
        out = by_hand(model, stored["mean"], stored.get("cov", None), *inputs)
        total, entries = total + out.log_likelihood.sum(), entries + int(seen.sum())
    return total, entries


@filters
@pytest.mark.parametrize("length", [TIME, 12, 6, 1])
def test_every_received_observation_counts_once_however_the_rollout_is_cut(length, covariance):
    agent, data = (make(torch.float64, covariance) for make in (make_belief_agent, make_data))
    assert data["next", "terminated"][:, :-1].any()
    assert data["next", "truncated"][:, :-1].any()
    assert data["is_init"].sum() > 3
    expected, entries = counted(agent, data)
    loss = make_loss(agent, model=BeliefModelLoss(reduction="sum"))
    sequences = cut(data, length)
    outs = [loss(minibatch).detach() for minibatch in sequences.split(sequences.shape[0] // 3)]
    total = -sum(out["loss_model"] for out in outs)
    torch.testing.assert_close(total, expected.detach(), rtol=1e-10, atol=1e-10)
    counts = sum((-out["loss_model"] / out["log_likelihood"]).item() for out in outs)
    assert counts == pytest.approx(entries, abs=1e-6)


@filters
def test_the_next_observation_is_predicted_from_the_live_belief_with_its_gradient(covariance):
    agent, data = (make(torch.float64, covariance) for make in (make_belief_agent, make_data))
    with torch.no_grad():
        for parameter in agent.belief.parameters():
            parameter += 0.05  # not the filter that collected
    data = data[:1]
    data["is_init"][:, 0] = True
    data["recurrent", "age"][:, 0] = 0
    expected, _ = counted(agent, data)
    out = make_loss(agent, model=BeliefModelLoss(reduction="sum"))(data)
    torch.testing.assert_close(-out["loss_model"], expected, rtol=1e-10, atol=1e-10)
    for received, wanted in zip(
        gradients(agent, -out["loss_model"]), gradients(agent, expected), strict=True
    ):
        torch.testing.assert_close(received, wanted, rtol=1e-8, atol=1e-8)


def test_renamed_entries_reach_the_held_losses():
    agent, data = make_belief_agent(), make_data()
    expected = make_loss(agent)(data)
    loss = make_loss(agent)
    for name, old, new in (
        ("advantage", "advantage", "adv"),
        ("value_target", "value_target", ("targets", "value")),
        ("sample_log_prob", "action_log_prob", "logp"),
        ("final", "final", "cut"),
        ("done", ("next", "done"), ("next", "over")),
        ("terminated", ("next", "terminated"), ("next", "fell")),
    ):
        data.rename_key_(old, new)
        loss.set_keys(**{name: new})
    out = loss(data)
    assert_identical(out, expected)
    for part in (loss, loss.ppo_loss, loss.model_loss):
        assert (part.tensor_keys.done, part.tensor_keys.terminated) == ("over", "fell")
    loss.set_keys(done=None, terminated="terminated")
    for part in (loss, loss.ppo_loss, loss.model_loss):
        assert (part.tensor_keys.done, part.tensor_keys.terminated) == ("done", "terminated")


def test_keys_set_on_a_held_loss_are_the_losss_own():
    loss = make_loss()
    loss.ppo_loss.set_keys(advantage="adv", reward="scaled_reward")
    loss.model_loss.set_keys(final="cut")
    assert (loss.tensor_keys.advantage, loss.tensor_keys.reward) == ("adv", "scaled_reward")
    assert {"adv", "cut"} <= set(loss.in_keys)
    data = make_data().rename_key_("advantage", "adv").rename_key_("final", "cut")
    assert torch.equal(loss(data)["loss_model"], make_loss()(make_data())["loss_model"])


def test_coefficients_are_those_of_the_held_loss():
    agent, data = make_belief_agent(), make_data()
    loss = make_loss(agent)
    for name, value in (("entropy_coeff", 0.3), ("critic_coeff", 0.1), ("clip_epsilon", 0.05)):
        setattr(loss, name, value)
        for part in (loss, loss.ppo_loss):
            assert getattr(part, name).item() == pytest.approx(value)
    given = make_loss(agent, ppo={"entropy_coeff": 0.3, "critic_coeff": 0.1, "clip_epsilon": 0.05})
    for key, value in given(data).items():
        torch.testing.assert_close(loss(data)[key], value, msg=key)
    loss.clip_epsilon = torch.tensor(0.2)
    assert loss.ppo_loss.clip_epsilon == pytest.approx(0.2)


@pytest.mark.parametrize("reduction", ["none", "sum", "mean"])
def test_the_reduction_is_that_of_every_term(reduction):
    agent, data = make_belief_agent(), make_data()
    loss = make_loss(agent)
    loss.reduction = reduction
    assert loss.reduction == loss.ppo_loss.reduction == loss.model_loss.reduction == reduction
    shape = data.shape if reduction == "none" else ()
    assert all(v.shape == shape for k, v in loss(data).items() if k.startswith("loss"))


def test_a_filter_with_keys_of_its_own_is_served():
    plain, data = make_belief_agent(), make_data()
    expected = make_loss(plain, detach_belief=True)(data)
    belief = BeliefFilterModule(
        make_filter(OBS, ACTION, torch.float64),
        in_keys={"observed": ("agent", "mask"), "is_init": "first"},
        out_keys={"features": "embed", ("belief", "log_likelihood"): "ll"},
    )
    agent = make_agent(belief, belief.feature_dim, features="embed")
    for old, new in (
        ("observed", ("agent", "mask")),
        (("next", "observed"), ("next", "agent", "mask")),
        ("is_init", "first"),
        (("next", "is_init"), ("next", "first")),
    ):
        data.rename_key_(old, new)
    model = BeliefModelLoss()
    model.set_keys(log_likelihood="ll")
    loss = make_loss(agent, model=model, detach_belief=True)
    loss.set_keys(observed=("agent", "mask"), is_init="first")
    out = loss(data)
    assert_identical(out, expected)


def test_what_a_head_reads_beside_the_features_is_among_the_in_keys():
    class Joined(nn.Linear):
        def forward(self, *inputs):
            return super().forward(torch.cat(inputs, -1))

    agent, data = make_belief_agent(), make_data()
    value = Joined(agent.critic.module.in_features + OBS, 1, dtype=torch.float64)
    critic = ValueOperator(value, in_keys=["features", ("simulator", "state")])
    loss = DRBPNLoss(agent.belief, ClipPPOLoss(agent.actor, critic), BeliefModelLoss())
    assert set(loss.in_keys) == {*make_loss(agent).in_keys, ("simulator", "state")}
    data["simulator", "state"] = torch.randn(*data.shape, OBS, dtype=torch.float64)
    loss(data.select(*loss.in_keys, strict=False))["loss_critic"].backward()
    assert value.weight.grad.abs().min() > 0


def test_a_norm_in_front_of_the_filter_scales_the_next_observation_too():
    data, norm = make_data(), MaskedObservationNorm(OBS)
    norm.update(data)
    belief = BeliefFilterModule(
        make_filter(OBS, ACTION, torch.float64), in_keys={"observation": "normalized_observation"}
    )
    agent = make_agent(belief, belief.feature_dim)
    outs = []
    for module in (TensorDictSequential(norm, belief), belief):
        outs.append(DRBPNLoss(module, make_ppo(agent), BeliefModelLoss())(data))
        norm(data)
        norm(data["next"])
    for key, value in outs[1].items():
        torch.testing.assert_close(outs[0][key], value, msg=key)


test_bad_use_is_one_clear_line = refuses(
    (lambda: make_loss()(make_data().exclude("advantage")), KeyError,
     "`advantage` is not in the tensordict: compute advantages"),
    (lambda: make_loss(model_coeff=-1.0), "`model_coeff` must be at least 0, got -1"),
    (lambda: make_loss().set_keys(advantages="a"),
     r"'advantages'.*DRBPNLoss; it accepts .*'advantage'"),
    (lambda: make_gru_loss(BeliefModelLoss()), r"`model_loss` reads .*not among the out_keys"),
)  # fmt: skip


@pytest.mark.parametrize("model_coeff", [0.0, 1.0])
def test_functional_or_not_gives_the_same_terms_and_gradients(model_coeff):
    agent, data = make_belief_agent(), make_data()
    options = {"model_coeff": model_coeff}
    outs = [make_loss(agent, ppo={"functional": f}, **options)(data) for f in (True, False)]
    assert_identical(*outs)
    assert all(map(torch.equal, *(gradients(agent, summed(out)) for out in outs)))


@filters
def test_every_tensor_is_made_on_the_device_of_the_input(covariance, monkeypatch):
    # "meta" refuses to be mixed with "cpu" as a GPU does; it has no numbers to choose steps by, so
    # all are taken, as in a compiled loss. TorchRL's functional parameters can't be moved there.
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    options = {"functional": False, "entropy_bonus": False}  # its entropy is looked at
    loss = make_loss(make_belief_agent(torch.float64, covariance), ppo=options)
    out = loss.to("meta")(make_data(torch.float64, covariance).to("meta"))
    assert {value.device.type for value in out.values(True, True)} == {"meta"}
