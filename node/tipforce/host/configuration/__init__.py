"""Configuration of a node: settings, calibration records and files, captures and measurements."""
