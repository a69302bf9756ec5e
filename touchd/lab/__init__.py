"""Measure the other rooms: run time against error, and the source paper's experiments."""
