"""Trained agents under conditions that they were not trained for."""
