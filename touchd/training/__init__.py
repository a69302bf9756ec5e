"""Train a model on a labelled recording: `train_network` and `train_atlas` are the front doors."""
