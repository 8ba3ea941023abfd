"""Running statistics in C: what PyTorch's operations give, for every size and kind of mask.

Specified here:

- learning batch after batch gives count, mean, squared deviations and scale of `masked_moments`,
  `merge_moments` and `variance`, to rounding in float64, from the first batch on;
- only the entries that were observed, in the rows that are flagged, are counted, whatever lies
  beneath the others; an entry that counts and is not finite teaches nothing;
- scaling gives PyTorch's results to the last bit;
- switched off, without contiguous memory and with a gradient PyTorch runs.
"""

from __future__ import annotations

import pytest
import torch

from torchrl_drbpn.functional import compiled
from torchrl_drbpn.functional.running import learn_native, scale_native, takes_native
from torchrl_drbpn.functional.statistics import Moments, masked_moments, merge_moments, variance

needs_compiler = pytest.mark.skipif(
    "there is no C compiler" in (compiled.native_error() or ""), reason="no C compiler here"
)
SIZES = [(1, 1), (16, 1), (16, 17), (3, 8), (33, 105)]
DTYPES = [torch.float32, torch.float64]


def nothing(n):
    return Moments(*torch.zeros(3, n, dtype=torch.float64))


@needs_compiler
@pytest.mark.parametrize("masks", ["none", "observed", "rows", "both"])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(("rows", "n"), SIZES)
def test_learning_gives_what_pytorch_gives(rows, n, dtype, masks):
    g = torch.Generator().manual_seed(rows + n)
    native = expected = nothing(n)
    for _ in range(6):
        x = torch.randn(rows, n, generator=g, dtype=dtype) * 5 + 100
        observed = torch.rand(rows, n, generator=g) < 0.7 if masks in ("observed", "both") else None
        flags = torch.rand(rows, generator=g) < 0.5 if masks in ("rows", "both") else None
        counted = None if masks == "none" else torch.ones(rows, n, dtype=torch.bool)
        for mask in (observed, None if flags is None else flags.unsqueeze(-1)):
            counted = counted if mask is None else counted & mask
        if counted is not None:
            x = x.masked_fill(~counted, torch.nan)  # what is not counted may be anything
        assert takes_native(x, observed)
        out = learn_native(native, x, observed, flags, 1e-8)
        native, expected = out.moments, merge_moments(expected, masked_moments(x, counted))
        scale = (variance(expected) + 1e-8).rsqrt()
        pairs = zip((*native, out.inverse_scale), (*expected, scale), strict=True)
        for got, wanted in pairs:
            torch.testing.assert_close(got, wanted, rtol=1e-12, atol=0)


@needs_compiler
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_an_entry_that_is_not_finite_teaches_nothing(bad):
    x, observed = torch.zeros(4, 3), torch.ones(4, 3, dtype=torch.bool)
    x[1, 2] = bad
    assert learn_native(nothing(3), x, observed, None, 1e-8) is None
    assert learn_native(nothing(3), x, None, None, 1e-8) is None
    assert learn_native(nothing(3), x, observed, torch.arange(4) != 1, 1e-8) is not None


@needs_compiler
@pytest.mark.parametrize("clip", [None, 1.5])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(("rows", "n"), SIZES)
def test_scaling_gives_the_bits_of_pytorch(rows, n, dtype, clip):
    g = torch.Generator().manual_seed(rows + n)
    x = torch.randn(rows, n, generator=g, dtype=dtype) * 5
    observed = torch.rand(rows, n, generator=g) < 0.7
    mean, inverse = torch.rand(2, n, generator=g, dtype=torch.float64)
    expected = (x.double() - mean) * inverse
    expected = expected if clip is None else expected.clamp(-clip, clip)
    assert torch.equal(scale_native(x, None, mean, inverse, clip), expected.to(dtype))
    expected = expected.masked_fill(~observed, 0.0).to(dtype)
    assert torch.equal(scale_native(x, observed, mean, inverse, clip), expected)
    assert scale_native(torch.full_like(x, torch.nan), None, None, inverse, clip).isnan().all()


@needs_compiler
def test_what_c_can_not_do_is_left_to_pytorch():
    x = torch.zeros(4, 4)
    assert takes_native(x)
    assert not takes_native(x.t()[1:].t())
    assert not takes_native(x, torch.ones(4, 8, dtype=torch.bool)[:, ::2])
    assert not takes_native(x, torch.ones(4, 4))
    assert not takes_native(x, torch.ones(4, 3, dtype=torch.bool))
    assert not takes_native(x.requires_grad_())
    assert not takes_native(x.detach().half())
