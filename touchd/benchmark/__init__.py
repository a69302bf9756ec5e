"""What `touchd benchmark` measures: run time against error, the daemon end to end, and what each skip saves."""
