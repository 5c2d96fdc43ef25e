"""The name under which applications of machine files import ``canopen_device.machine``."""

from canopen_device.machine import *  # noqa: F403
