"""Score models and replays on labelled recordings, and compute bounds on the error."""
