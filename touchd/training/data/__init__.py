"""Training data: inspect, join, augment, and reduce to one temperature."""
