"""Shared by all commands: entry point, arguments, bus flags, output."""
