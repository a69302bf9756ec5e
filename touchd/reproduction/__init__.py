"""The source paper's experiments, run again: on the digital twin, or on any labelled recording."""
