"""A bus as it happens: frames received in batches, filtered, and sent."""
