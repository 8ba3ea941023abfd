"""Videos and pictures of an agent and its belief."""
