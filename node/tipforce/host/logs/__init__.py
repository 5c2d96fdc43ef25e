"""Recorded traffic: read any log file as blocks of frames, write frames as candump text."""
