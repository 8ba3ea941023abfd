"""A batched, differentiable belief filter with per-component missing data, wired into TorchRL."""
