"""The digital twin: a plate, its transducers, what touches it, and the instrument that listens."""
