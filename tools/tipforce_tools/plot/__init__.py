"""`tipforce plot`: plots of a log."""
