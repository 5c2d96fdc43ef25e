"""Commands for the nodes on a bus: scan, nmt, lss, config, tare, load."""
