"""Augmentation methods of the examples, one module each."""
