"""The source paper's experiments: `run` is the front door."""
