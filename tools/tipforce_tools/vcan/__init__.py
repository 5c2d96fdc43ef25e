"""`tipforce vcan`: run a command on a kernel that has virtual CAN buses."""
