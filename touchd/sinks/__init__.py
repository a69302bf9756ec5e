"""Where events go: `zeromq` is the event bus, `jsonl` prints."""
