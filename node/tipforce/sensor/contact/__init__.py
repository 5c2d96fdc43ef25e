"""Gauge strain to force and contact, with uncertainty and redundancy; scalar*.py also run on MicroPython."""
