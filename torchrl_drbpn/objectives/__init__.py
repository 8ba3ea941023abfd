"""The model likelihood as a loss, and DRBPN: PPO plus that likelihood."""

from torchrl_drbpn.objectives.belief_model import BeliefModelLoss
from torchrl_drbpn.objectives.drbpn import DRBPNLoss

__all__ = ["BeliefModelLoss", "DRBPNLoss"]
