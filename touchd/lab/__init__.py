"""Measurements of everything else: run time against error, and the source paper's experiments."""
