"""For all tests: random examples are the same in every run, and no test fails because a machine is slow."""

from hypothesis import settings

settings.register_profile("tipforce", derandomize=True, deadline=None)
settings.load_profile("tipforce")
