"""A hand of many nodes: bring-up from a file, reading in coherent rows, supervision, recovery."""
