"""Datasets: the samples of many logs as Parquet files that a manifest lists."""
