"""Pictures of models, error maps and replayed sessions."""
