"""The report that a training leaves beside its model."""
