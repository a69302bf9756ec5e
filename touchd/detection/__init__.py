"""Is a frame a measurement, and is the plate touched? `baseline` and `gate` decide."""
