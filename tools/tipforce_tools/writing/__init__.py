"""Rows of logs as files: text, Parquet, MCAP, and the parts of a dataset."""
