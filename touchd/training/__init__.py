"""From a labelled recording to a model. Needs the extra `train`; nothing here is imported by the daemon."""
