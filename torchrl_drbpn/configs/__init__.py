"""Nodes for Hydra configurations of ``torchrl.trainers``, registered on request."""

from torchrl_drbpn.configs.nodes import make_ppo_trainer, register

__all__ = ["make_ppo_trainer", "register"]
