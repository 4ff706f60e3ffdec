"""What the steps of the examples share."""
