"""PDO data to values in bulk, and where the PDO layouts come from."""
