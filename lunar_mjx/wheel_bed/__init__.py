"""The single-wheel test bed: simulated, read from tables, compared and refitted."""
