"""Estimators that put the bound to the test: alignment, Monte Carlo trials, feature tracks."""
