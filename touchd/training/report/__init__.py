"""The report that training writes beside a model."""
