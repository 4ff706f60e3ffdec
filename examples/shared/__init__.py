"""Helpers that the steps of the examples share."""
