"""The network: layers, objectives, training loop, export."""
