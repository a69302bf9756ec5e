"""Plots of models, error maps and replayed sessions (matplotlib, extra `train`)."""
