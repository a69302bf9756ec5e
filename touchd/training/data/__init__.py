"""Touches for training: inspected, joined, augmented, and brought to one temperature."""
