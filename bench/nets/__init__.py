"""Nets under a change of the whole layout; `python -m bench.nets --help`."""
