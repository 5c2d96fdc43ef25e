"""Bus and nodes: connection, discovery, NMT, LSS, SDO, one finger, bus load."""
