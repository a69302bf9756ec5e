"""Plates that a calibration is proved on: other physics than the fit has, and constants that it is not told."""
