"""How the structure moves: modes, the exact held step, impacts, the slit, integrators to compare with."""
