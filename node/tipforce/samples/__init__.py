"""Samples: their columns, the joining of PDOs to samples and of samples to rows, and why a value is unknown."""
