"""One hand of many nodes: brought up from a file, read in coherent rows, supervised, mended."""
