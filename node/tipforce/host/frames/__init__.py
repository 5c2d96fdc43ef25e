"""Frames in bulk: arrays, blocks with interface names, CAN FD frames."""
