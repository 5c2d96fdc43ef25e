"""The other end of the bus: find, configure, calibrate, read and decode fingertips."""
