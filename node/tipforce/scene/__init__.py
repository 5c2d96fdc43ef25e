"""TOML scenes: loads, nodes, faults and outputs; each builds only the parts that it names."""
