"""What every belief module refuses, by name; see suites.py."""

import pytest
import torch
from belief_frames import BeliefFrames
from suite_environments import ACTION, OBS
from torchrl.modules import set_recurrent_mode


class BeliefModuleRefusals(BeliefFrames):
    """Keys, entries and readings that a belief module can not use."""

    # --- hook
    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        """Return a module, equal to every other made with the same arguments."""
        raise NotImplementedError(f"{type(self).__name__} must say in `make_module` what is tested")

    def any_module(self):
        return self.make_module()

    # --- tests
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
