"""The physics, without CAN: geometry, strain, force, contact, calibration, design."""
