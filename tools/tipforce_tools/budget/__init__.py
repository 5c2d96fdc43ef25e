"""`tipforce budget`: the error budget."""
