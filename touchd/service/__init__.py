"""The daemon: `daemon` composes it, `loop` runs it, `runner` is the one loop over a source's frames."""
