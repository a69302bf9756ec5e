"""From a labelled recording to a model: `train_network` and `train_atlas` are the front doors."""
