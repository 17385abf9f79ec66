"""Reads logs from folders, plain tables, MATLAB and Parquet files, and recordings of other tools."""
