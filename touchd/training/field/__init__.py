"""The residual field of a touch at any position, learned by Gaussian process regression."""
