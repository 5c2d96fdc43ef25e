"""What a node holds: settings, calibration records and files, captures and measurements."""
