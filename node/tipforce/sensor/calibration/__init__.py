"""The calibration fit: readings under known loads to C, offsets and their uncertainty."""
