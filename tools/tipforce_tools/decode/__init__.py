"""`tipforce decode`: logs to tables of samples."""
