"""Fit the filter to logged data: reading logs, training, and what it is compared with."""
