"""Where events go: `zeromq` is the event bus, `sink` is what a sink does, and the one that prints."""
