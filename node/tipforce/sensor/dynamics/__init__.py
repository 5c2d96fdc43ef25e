"""Dynamics of the structure: modes, the exact held step, impacts, the slit, integrators for comparison."""
