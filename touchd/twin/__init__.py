"""The digital twin: a plate with its transducers and electronics, and what touches it."""
