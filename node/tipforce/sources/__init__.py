"""Gauge sources of a node: simulated, with a front end and dynamics, replayed, and Linux Industrial I/O."""
