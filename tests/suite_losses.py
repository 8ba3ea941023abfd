"""Requirements of every loss; see suites.py."""

import copy

import pytest
import torch
from suite_environments import heirs


class LossSuite:
    """Requirements of a loss: what a TorchRL LossModule promises."""

    has_networks = True

    # --- hooks
    def make_loss(self, **kwargs):
        """Return a loss, equal to every other that this method returns."""
        raise NotImplementedError(f"{type(self).__name__} must say in `make_loss` what is tested")

    def make_loss_data(self, dtype=torch.float32):
        """Return a minibatch, `[batch, time]`."""
        raise NotImplementedError

    # --- helpers
    def _total(self, out):
        terms = [v for k, v in out.items() if isinstance(k, str) and k.startswith("loss")]
        assert terms
        return torch.stack([term.sum() for term in terms]).sum()

    def _assert_equal(self, received, expected):
        assert set(received.keys(True, True)) == set(expected.keys(True, True))
        for key in expected.keys(True, True):
            torch.testing.assert_close(received[key], expected[key])

    # --- keys
    def test_in_keys_are_all_that_is_read(self):
        loss, data = self.make_loss(), self.make_loss_data()
        self._assert_equal(loss(data.select(*loss.in_keys, strict=False)), loss(data))

    def test_out_keys_are_written_and_hold_every_term_to_be_summed(self):
        loss = self.make_loss()
        written = set(loss(self.make_loss_data()).keys(True, True))
        assert set(loss.out_keys) <= written
        assert {key for key in written if key.startswith("loss")} <= set(loss.out_keys)

    def test_dispatch_takes_tensors_by_name(self):
        loss, data = self.make_loss(), self.make_loss_data()
        given = {key: data.get(key, None) for key in loss.in_keys}
        names = {key: key if isinstance(key, str) else "_".join(key) for key in given}
        received = loss(**{names[k]: value for k, value in given.items() if value is not None})
        for value, wanted in zip(received, loss(data).select(*loss.out_keys).values(), strict=True):
            torch.testing.assert_close(value, wanted)

    def test_the_input_and_the_global_generator_are_left_as_they_were(self):
        loss, data = self.make_loss(), self.make_loss_data()
        before, state = data.clone(), torch.get_rng_state()
        loss(data)
        assert torch.equal(torch.get_rng_state(), state)
        assert set(data.keys(True, True)) == set(before.keys(True, True))
        for key in before.keys(True, True):
            assert torch.equal(data[key], before[key]), key

    def test_compiled_without_a_break_it_is_the_same(self):
        loss, data = self.make_loss(), self.make_loss_data()
        compiled = torch.compile(loss, fullgraph=True, backend="eager")
        self._assert_equal(compiled(data), loss(data))

    # --- parameters
    def test_parameters_are_there_once_and_all_get_a_gradient(self):
        loss = self.make_loss()
        parameters = dict(loss.named_parameters())
        assert bool(parameters) == self.has_networks
        assert len({id(p) for p in parameters.values()}) == len(parameters)
        if self.has_networks:
            self._total(loss(self.make_loss_data())).backward()
        for name, parameter in parameters.items():
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all(), name

    def test_the_state_survives_a_file_and_a_copy_shares_nothing(self):
        loss, data = self.make_loss(), self.make_loss_data()
        received, expected = heirs(loss, self.make_loss(), lambda loss: loss(data))
        assert not {*map(id, loss.parameters())} & {*map(id, copy.deepcopy(loss).parameters())}
        for out in received:
            self._assert_equal(out, expected)

    @pytest.mark.gpu
    def test_it_moves_to_a_gpu(self):
        loss, data = self.make_loss(), self.make_loss_data()
        expected = self._total(loss(data)).item()
        loss = loss.to("cuda")
        total = self._total(loss(data.to("cuda")))
        assert total.device.type == "cuda"
        assert total.item() == pytest.approx(expected, rel=1e-3, abs=1e-4)

    def test_parameters_can_be_reset(self):
        loss = self.make_loss()
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter += 1000
        before = {name: p.clone() for name, p in loss.named_parameters()}
        loss.reset_parameters_recursive()
        for name, parameter in loss.named_parameters():
            assert (parameter != before[name]).any(), name
