"""For all tests: random examples are the same in every run, and no test fails because a machine is slow."""

import os

# The workers of a test run share the cores: threads of the linear algebra library would only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from hypothesis import settings

settings.register_profile("tipforce", derandomize=True, deadline=None)
settings.load_profile("tipforce")
