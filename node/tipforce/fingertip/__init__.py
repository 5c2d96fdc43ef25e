"""The application on the device: gauge source, sample, estimate, objects, and the loop that runs nodes."""
