"""One module per area: cases()."""
