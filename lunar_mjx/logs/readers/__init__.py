"""Reads measurement logs from folders, tables and recordings of other tools."""
