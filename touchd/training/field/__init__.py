"""The field of a touch anywhere on the plate, learned by Gaussian process regression."""
