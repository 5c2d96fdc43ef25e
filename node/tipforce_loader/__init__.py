"""The part of a microcontroller's firmware that an update does not replace: it chooses, checks and starts a program. It
imports nothing of ``tipforce`` or ``firmware``: those come from the program that it starts."""
