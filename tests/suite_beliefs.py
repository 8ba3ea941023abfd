"""Requirements of every belief module; see suites.py."""

import warnings
from functools import partial

import pytest
import torch
from belief_frames import BeliefFrames
from suite_environments import (
    ACTION,
    OBS,
    StaircaseEnv,
    belief_env,
    heirs,
    parallel_env,
    with_belief_entries,
)
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import GRUModule, canonicalize_rnn_subset, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module

from torchrl_drbpn import GymnasiumBatchEnv


class BeliefModuleSuite(BeliefFrames):
    """What `GRUModule` does in a TorchRL pipeline, and the age rule.

    One step at a time `is_init` starts from the module's initial state. Over time `is_init & (age
    == 0)` does, and `is_init` with an older age takes the stored state; without `is_init` the state
    of the step before is taken.
    """

    age_key = ("recurrent", "age")  # counts updates since the reset
    all_outputs = None  # every entry that the module can write

    # --- hooks
    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        """Return a module, equal to every other made with the same arguments."""
        raise NotImplementedError(f"{type(self).__name__} must say in `make_module` what is tested")

    def any_module(self):
        return self.make_module()

    def differentiable(self, out):
        """Return a number that depends on everything the module learns from."""
        return out["features"].square().mean()

    # --- keys
    def test_keys_can_be_renamed_nested_ones_included(self):
        plain, age = self.make_module(), ("agent", "count")
        names = {"observation": ("agent", "observation"), "is_init": "i", self.age_key: age}
        named = self.make_module(in_keys=names, out_keys={"features": ("agent", "embed")})
        short = self.make_module(in_key=("agent", "observation"), out_key=("agent", "embed"))
        frames = self.one_by_one(plain, self.make_frames((3, 4)), self.some_state(plain, (3,)))
        expected = self.as_sequence(plain, frames)
        frames = frames.select(*plain.in_keys)
        frames.rename_key_("observation", ("agent", "observation"))
        with set_recurrent_mode(True):
            outputs = {self.age_key: short(frames.clone())}
            outputs[age] = named(frames.rename_key_("is_init", "i").rename_key_(self.age_key, age))
        for key, out in outputs.items():
            assert torch.equal(out["agent", "embed"], expected["features"])
            assert torch.equal(out["next"][key], expected["next"][self.age_key])
            assert "features" not in out

    @pytest.mark.parametrize("over_time", [False, True])
    def test_a_mask_declared_absent_is_all_true_and_an_action_zero(self, over_time):
        module = self.make_module()
        frames = self.make_frames((2, 3))
        frames["observed"][:], frames["previous_action"][:] = True, 0.0
        data = self.one_by_one(module, frames, self.some_state(module, (2,)))
        data = data.select(*module.in_keys)
        without = self.make_module(in_keys={"observed": None, "previous_action": None})
        assert len(without.in_keys) == len(module.in_keys) - 2
        with set_recurrent_mode(over_time):
            expected = module(data.clone())
            self.assert_same(module, without(data.select(*without.in_keys)), expected)

    def by_name(self, module, step):
        return {k if isinstance(k, str) else "_".join(k): step[k] for k in module.in_keys}

    def test_dispatch_takes_tensors_by_name(self):
        module = self.make_module()
        step = self.one_by_one(module, self.make_frames((3, 4)), None)[:, 1]
        received = module(**self.by_name(module, step))
        for key, value in zip(module.out_keys, received, strict=True):
            assert torch.equal(value, step[key]), key

    # --- what is refused, by name
    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"in_keys": ["observation"]}, "`in_keys` must have 4 or"),
            ({"in_keys": {"obs": "a"}}, "`in_keys` names"),
            ({"in_keys": {"is_init": None}}, r"must name \['is_init'\]"),
            ({"in_keys": ["x", "x", "a", "i"]}, "`in_keys` must give .* of its own: x twice"),
            ({"in_key": "x", "in_keys": {}}, "`in_key` and `in_keys` were both given"),
            ({"out_key": "x", "out_keys": []}, "`out_key` and `out_keys` were both given"),
            ({"out_keys": {"feature": "a"}}, "`out_keys` names"),
            ({"out_keys": {"features": "x", ("belief", "log_likelihood"): "x"}}, "x twice"),
            ({"out_keys": ["features", ("next", "rnn")]}, "`out_keys` names .*'rnn'.* in_keys"),
        ],
    )
    def test_a_wrong_key_is_refused(self, kwargs, message):
        with pytest.raises(ValueError, match=message):
            self.make_module(**kwargs)

    @pytest.mark.parametrize("name", ["in_keys", "out_keys"])
    def test_a_string_is_refused_as_a_list_of_keys_and_a_list_is_a_nested_key(self, name):
        with pytest.raises(TypeError, match=f"`{name}` must be a list of keys or a dict, got 'f"):
            self.make_module(**{name: "features"})
        module = self.make_module(in_keys=["a", ["b", "c"], "d", "e"], out_keys=["features"])
        assert module.in_keys[:4] == ["a", ("b", "c"), "d", "e"]

    @pytest.mark.parametrize(
        ("absent", "remedy"),
        [
            ("observation", "in_keys"),
            ("observed", "ObservationMissingness"),
            ("previous_action", "PreviousAction"),
            ("is_init", "InitTracker"),
        ],
    )
    def test_an_absent_entry_is_named_with_its_remedy(self, absent, remedy):
        with pytest.raises(KeyError, match=f"`{absent}` is not in the tensordict.*{remedy}"):
            self.make_module()(self.make_frames((3,)).exclude(absent))

    def test_a_sequence_without_a_batch_dimension_and_a_mask_of_numbers_are_refused(self):
        with set_recurrent_mode(True), pytest.raises(ValueError, match="no batch dimension"):
            self.make_module()(self.make_frames(()))
        data = self.make_frames((3, 4))
        data["observed"] = data["observed"].float()
        with set_recurrent_mode(True), pytest.raises((ValueError, RuntimeError), match="bool"):
            self.make_module()(data)

    @pytest.mark.parametrize("over_time", [False, True])
    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            (torch.nan, r"NaN .*components \[3\].*ObservedFromNaN"),
            (torch.inf, r"infinite readings .*components \[3\].*`observed` to False"),
            (1e25, r"readings over .*squares overflow .*components \[3\].*MaskedObservationNorm"),
        ],
    )
    def test_a_reading_that_is_not_usable_is_named(self, over_time, wrong, message):
        module = self.make_module()
        data = self.one_by_one(module, self.make_frames((3, 4)), self.some_state(module, (3,)))
        data["observed"][1, 2, 3], data["observation"][1, 2, 3] = True, wrong
        refused = pytest.raises(ValueError, match=f"`observation` holds {message}")
        with set_recurrent_mode(over_time), refused:
            module(data.select(*module.in_keys))

    # --- shapes, steps, sequences
    @pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
    def test_one_step_takes_any_batch_shape(self, shape):
        module, count = self.make_module(), torch.Size(shape).numel()
        each = self.one_by_one(module, self.make_frames((6, 1)), self.some_state(module, (6,)))
        each = each[:count, 0]
        out = module(each.select(*module.in_keys).reshape(shape))
        assert out.batch_size == torch.Size(shape)
        self.assert_same(module, out.reshape(-1), each)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 3, 2)])
    @pytest.mark.parametrize("start", ["episode start", "mid-episode"])
    def test_step_by_step_equals_the_whole_sequence(self, dtype, shape, start):
        module = self.make_module(dtype=dtype)
        count = torch.Size(shape).numel()
        frames = self.make_frames((count, 12), dtype)
        frames["is_init"][0, 5] = True
        frames["is_init"][-1, [3, 4, 9]] = True
        frames["is_init"][:, 0] = start == "episode start"
        state = None if start == "episode start" else self.some_state(module, (count,))
        rollout = self.one_by_one(module, frames, state)
        assert rollout["features"].dtype == dtype
        strided = rollout.transpose(0, 1).contiguous().transpose(0, 1)
        assert count == 1 or not strided["observation"].is_contiguous()
        out = self.as_sequence(module, strided.reshape(*shape, 12))
        assert out.batch_size == (*shape, 12)
        self.assert_same(module, out.reshape(count, 12), rollout)

    def test_is_init_with_an_older_age_joins_slices_over_time_and_resets_one_step_at_a_time(self):
        # two slices of one episode in one row, as TorchRL's SliceSampler lays them out
        module = self.make_module(dtype=torch.float64)
        frames = self.make_frames((2, 12), torch.float64)
        frames["is_init"][:, 0] = True
        rollout = self.one_by_one(module, frames, None)
        slices = [rollout[:, 2:5].clone(), rollout[:, 8:12].clone()]
        for piece in slices:
            piece["is_init"][:, 0] = True
        joined = torch.cat(slices, 1)
        expected = torch.cat([rollout[:, 2:5], rollout[:, 8:12]], 1)
        assert (joined[self.age_key][:, [0, 3]] > 0).all()
        self.assert_same(module, self.as_sequence(module, joined), expected)
        joint = joined[:, 3].select(*module.in_keys)
        alone = module(joint.clone())
        assert alone["next"][self.age_key].eq(1).all()
        for key in self.state_keys(module):
            joint[key].zero_()
        self.assert_same(module, alone, module(joint))

    def test_an_episode_start_ignores_whatever_state_is_stored(self):
        module = self.make_module()
        frames = self.make_frames((3, 4))
        frames["is_init"][:, [0, 2]] = True
        rollout = self.one_by_one(module, frames, None)
        dirty = rollout.clone()
        for key in self.state_keys(module):
            if dirty[key].is_floating_point():
                dirty[key][:, [0, 2]] = 7.0
        self.assert_same(module, self.as_sequence(module, dirty), rollout)
        self.assert_same(module, module(dirty.select(*module.in_keys)), rollout)

    @pytest.mark.parametrize("over_time", [False, True])
    def test_without_recurrent_entries_rows_start_from_the_initial_state_with_one_warning(
        self, over_time
    ):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][1, 3] = True
        with set_recurrent_mode(over_time):
            with pytest.warns(UserWarning, match=r"make_tensordict_primer\(\)"):
                received = module(frames.clone())
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                module(frames.clone())
        frames["is_init"][:, slice(0, 1 if over_time else None)] = True
        expected = self.one_by_one(module, frames, None)
        self.assert_same(module, received, expected)
        assert torch.equal(received["next"][self.age_key], expected["next"][self.age_key])

    @pytest.mark.parametrize("over_time", [False, True])
    def test_a_part_of_the_recurrent_state_is_an_error_that_names_the_rest(self, over_time):
        module = self.make_module()
        rollout = self.one_by_one(module, self.make_frames((3, 2)), None)
        data = rollout.select(*module.in_keys).exclude(self.age_key)
        with (
            set_recurrent_mode(over_time),
            pytest.raises(KeyError, match=r"'recurrent', 'age'.*make_tensordict_primer\(\)"),
        ):
            module(data)

    # --- modes
    @pytest.mark.parametrize("default", [None, False, True])
    def test_the_mode_is_a_context_or_a_default(self, default):
        module = self.make_module(default_recurrent_mode=default)
        assert module.recurrent_mode is bool(default)
        for mode, expected in ((True, True), (False, False), ("recurrent", True)):
            with set_recurrent_mode(mode), set_recurrent_mode(mode):
                assert module.recurrent_mode is expected
        assert module.recurrent_mode is bool(default)
        rollout = self.one_by_one(module, self.make_frames((3, 6)), self.some_state(module, (3,)))
        data = rollout.select(*module.in_keys)
        with set_recurrent_mode(bool(default)):
            expected = module(data.clone())["features"]
        assert torch.equal(module(data)["features"], expected)

    # --- TorchRL's machinery
    def test_its_primer_is_found_inside_a_sequence(self):
        module = self.make_module()
        policy = self.make_policy(module, ACTION)
        primer = get_primers_from_module(policy)
        assert set(primer.primers.keys(True, True)) == set(self.state_keys(module))
        # An environment without a device resets on the CPU, whatever the policy runs on.
        specs = self.make_module().to("meta").make_tensordict_primer().primers.values(True, True)
        assert all(spec.device is None or spec.device.type == "cpu" for spec in specs)
        env = with_belief_entries(TransformedEnv(StaircaseEnv(), Compose()), primer)
        check_env_specs(env)
        data = env.rollout(8, policy, break_when_any_done=False)
        assert data["next", "done"].any()
        self.check_collected(module, data)

    def check_collected(self, module, data):
        """Assert that a rollout's beliefs are those of its frames, run over time."""
        age = torch.zeros_like(data[self.age_key][..., 0, :])
        for t in range(data.shape[-1]):
            started = data["is_init"][..., t, :] | (t == 0)
            stored = data[self.age_key][..., t, :]
            age = torch.where(started, stored if t == 0 else torch.zeros_like(age), age)
            assert torch.equal(stored, age)
            age = age + 1
        self.assert_same(module, self.as_sequence(module, data), data)

    def make_policy(self, module, actions):
        head = TensorDictModule(nn.LazyLinear(actions), ["features"], ["action"])
        return TensorDictSequential(module, head)

    def test_only_its_own_entries_are_made_contiguous(self):
        module = self.make_module()
        gru = GRUModule(input_size=OBS, hidden_size=3, in_key="observation", out_key="gru")
        data = self.make_frames((2, 5)).set("other", torch.zeros(5, 2).mT)
        data["observation"] = torch.zeros(OBS, 5, 2).permute(2, 1, 0)
        out = canonicalize_rnn_subset(data, [gru, module])
        own = module.canonicalize(data)
        assert out["observation"].is_contiguous()
        assert own["observation"].is_contiguous()
        assert own["other"].data_ptr() == data["other"].data_ptr()
        assert not data["observation"].is_contiguous()
        assert module.canonicalize(data, inplace=True) is data
        assert data["observation"].is_contiguous()

    @pytest.mark.parametrize("kind", ["serial", "parallel", "gymnasium"])
    def test_it_runs_in_batched_environments(self, kind):
        module = self.make_module(4, 1)
        primer = module.make_tensordict_primer
        if kind == "gymnasium":
            base = TransformedEnv(GymnasiumBatchEnv("InvertedPendulum-v5", 2), Compose())
            env = with_belief_entries(base, primer())
        elif kind == "serial":
            env = SerialEnv(2, lambda: belief_env(primer()))
        else:
            env = parallel_env(2, partial(belief_env, primer()))
        policy = self.make_policy(module, 1)
        try:
            env.set_seed(0)
            with torch.no_grad():
                data = env.rollout(40, policy, break_when_any_done=False).contiguous()
        finally:
            env.close(raise_if_closed=False)
        assert data["is_init"][:, 1:].any()
        self.check_collected(module, data)

    @pytest.mark.parametrize("over_time", [False, True])
    def test_compiled_without_a_graph_break_equals_eager(self, over_time):
        module = self.make_module()
        frames = self.make_frames((3, 4))
        frames["is_init"][1, 2] = True
        rollout = self.one_by_one(module, frames, self.some_state(module, (3,)))
        data = rollout.select(*module.in_keys).detach()
        torch._dynamo.reset()
        compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
        with set_recurrent_mode(over_time):
            expected, received = module(data.clone()), compiled(data.clone())
        self.assert_same(module, received, expected)
        parameters = list(module.parameters())
        grad = partial(torch.autograd.grad, inputs=parameters, materialize_grads=True)
        outs = (received, expected)
        torch.testing.assert_close(*(grad(self.differentiable(out)) for out in outs))

    def test_a_single_step_policy_can_be_exported(self):
        module = self.make_module()
        policy = self.make_policy(module, ACTION)
        step = self.one_by_one(module, self.make_frames((3, 2)), None)[:, 1]
        step = step.select(*module.in_keys).detach()
        policy(step.clone())
        policy.select_out_keys("action", *[("next", *key) for key in self.state_keys(module)])
        kwargs = self.by_name(module, step)
        exported = torch.export.export(policy, args=(), kwargs=kwargs, strict=False).module()
        for one, other in zip(exported(**kwargs), policy(**kwargs), strict=True):
            torch.testing.assert_close(one, other)

    @pytest.mark.parametrize("over_time", [False, True])
    def test_every_tensor_is_made_on_the_device_of_the_input(self, over_time):
        # the device "meta" refuses to be mixed with "cpu", as a GPU does
        module = self.make_module(out_keys=self.all_outputs)
        data = self.one_by_one(module, self.make_frames((3, 4)), self.some_state(module, (3,)))
        data, module = data.select(*module.in_keys).detach().to("meta"), module.to("meta")
        module.filter.validate = False
        with set_recurrent_mode(over_time):
            out = module(data)
        assert all(out[key].device.type == "meta" for key in module.out_keys)
        self.differentiable(out).backward()
        assert all(p.grad is None or p.grad.device.type == "meta" for p in module.parameters())

    # --- parameters
    def test_the_state_survives_a_file_and_a_copy_shares_nothing(self):
        first, loaded = self.make_module(), self.make_module()
        data = self.one_by_one(first, self.make_frames((3, 4)), self.some_state(first, (3,)))
        run = lambda module: self.as_sequence(module, data)["features"].clone()  # noqa: E731
        received, expected = heirs(first, loaded, run)
        assert all(torch.equal(features, expected) for features in received)

    def test_every_parameter_gets_a_finite_gradient_over_time_and_is_drawn_anew(self):
        module = self.make_module()
        frames = self.make_frames((3, 6))
        frames["is_init"][:, 0] = True
        out = self.as_sequence(module, self.one_by_one(module, frames, None))
        self.differentiable(out).backward()
        for name, parameter in module.named_parameters():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.any(), name
        before = [parameter.detach().clone() for parameter in module.parameters()]
        module.reset_parameters()
        after = list(module.parameters())
        assert any(not torch.equal(a, b) for a, b in zip(after, before, strict=True))
        assert all(parameter.isfinite().all() for parameter in after)

    def test_the_content_of_a_missing_entry_changes_neither_values_nor_gradient(self):
        found = []
        for junk in (0.0, 1e30, float("nan"), float("inf")):
            module = self.make_module(dtype=torch.float64)
            data = self.one_by_one(module, self.make_frames((3, 5), torch.float64), None)
            data["observation"] = torch.where(data["observed"], data["observation"], junk)
            out = self.as_sequence(module, data.detach())
            (out["features"].sum() + out["belief", "log_likelihood"].sum()).backward()
            parts = [out[key].detach() for key in self.written(module)]
            parts += [p.grad for p in module.parameters() if p.grad is not None]
            found.append(torch.cat([part.flatten() for part in parts]))
        assert all(torch.equal(one, found[0]) for one in found)

    @pytest.mark.gpu
    def test_it_moves_to_a_gpu(self):
        module = self.make_module()
        data = self.one_by_one(module, self.make_frames((3, 6)), None).detach()
        expected = self.as_sequence(module, data)
        received = self.as_sequence(module.to("cuda"), data.to("cuda"))
        self.differentiable(received).backward()
        for key in self.written(module):
            assert received[key].device.type == "cuda"
            torch.testing.assert_close(received[key].cpu(), expected[key], rtol=1e-3, atol=1e-4)
