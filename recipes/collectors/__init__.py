"""Where rollouts come from, other than from this process."""
