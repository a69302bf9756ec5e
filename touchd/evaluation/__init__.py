"""Score models and replays on labelled recordings, and bound what any estimator could reach."""
