"""`tipforce simulate`: CANopen devices of any manufacturer."""
