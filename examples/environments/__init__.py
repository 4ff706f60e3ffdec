"""Environments of the examples, one module each."""
