"""The parts of the calibration fit; `tipforce.sensor.calibration` puts them together."""
