"""The object dictionary as one table, and what is generated from it: EDS, DBC, typed entries, PDO signals."""
