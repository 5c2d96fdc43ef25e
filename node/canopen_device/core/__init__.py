"""A CANopen device as a pure state machine (CiA 301, 305): frames and time in, frames out. Runs on MicroPython."""
