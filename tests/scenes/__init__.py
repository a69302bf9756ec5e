"""Whole scenes of the twin through the whole pipeline, with the shipped model."""
