"""Error against run time, and the behaviour in extreme cases."""
