"""Learners of the examples, one module each."""
