"""How good a model or a whole replay is, and pictures of it."""
