"""Parts of the recipes: one job each, plain arguments, no Hydra."""
