"""Decode PDO data in bulk, with PDO layouts from several sources."""
