"""Model of the structure: geometry, gauge layouts, strain per force, beam and frame models."""
