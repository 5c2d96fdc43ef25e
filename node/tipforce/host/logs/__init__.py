"""Recorded traffic: any log file as blocks of frames, and frames as candump's text."""
