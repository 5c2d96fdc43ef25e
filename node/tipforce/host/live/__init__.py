"""Live bus access: frames received in batches, filtered, and sent."""
