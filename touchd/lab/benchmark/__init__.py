"""Run time against error, and the daemon end to end: `measure` is the front door."""
