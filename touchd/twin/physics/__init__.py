"""Plate theory: flexural waves, transducers and fingers."""
