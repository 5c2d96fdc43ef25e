"""`tipforce monitor`: a live table of nodes; the state is separate from the display."""
