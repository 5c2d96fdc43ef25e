"""A kernel that has virtual CAN buses: this machine's, or User-mode Linux."""
