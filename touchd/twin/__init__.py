"""The digital twin: plate, transducers, electronics, and scenes of touches."""
