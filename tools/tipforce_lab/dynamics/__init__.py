"""Impacts, integrators and sampling: what the simulated node does not need."""
