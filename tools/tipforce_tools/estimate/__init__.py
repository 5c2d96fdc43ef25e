"""`tipforce estimate`: gauge readings to contact."""
