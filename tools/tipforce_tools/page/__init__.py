"""The web page with the force on each fingertip, for `tipforce view` and `demo --view`."""
