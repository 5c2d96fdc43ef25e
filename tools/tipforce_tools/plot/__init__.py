"""`tipforce plot`: a log as a picture."""
