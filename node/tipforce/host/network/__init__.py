"""The bus and its nodes: connection, discovery, NMT, LSS, SDO, one finger, bus load."""
