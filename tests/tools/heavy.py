"""Packages that no command imports before it needs them."""

OF_ALL = ("numpy", "can", "canopen", "cantools", "msgspec", "rich", "shtab", "websockets")
