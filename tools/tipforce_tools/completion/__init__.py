"""`tipforce completion`: scripts for the TAB key, made from the parsers of all commands."""
