"""Numerical stress: float64 beside the fast path, inputs at the limits, long runs, and how errors grow."""
