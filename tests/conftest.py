"""What holds for every test: the global generator and the number of threads are given back."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(autouse=True)
def _global_state() -> Iterator[None]:
    """Recipes set both; no test may depend on which one ran before."""
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        yield
    torch.set_num_threads(threads)
