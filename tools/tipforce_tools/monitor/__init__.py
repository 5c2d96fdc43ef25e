"""`tipforce monitor`: a live table of nodes; what is known of them (state) apart from how it is shown (display)."""
