"""What all commands share: entry point, arguments, bus flags, output."""
