"""`tipforce sdo`: read and write objects."""
