"""The daemon: `daemon` puts it together, `loop` runs it."""
