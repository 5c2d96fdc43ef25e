"""A CANopen device (CiA 301, CiA 305) without I/O: frames and time in, frames and the next due time out."""
