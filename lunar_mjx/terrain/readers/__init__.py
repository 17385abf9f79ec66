"""Readers of digital elevation models: every format becomes a `Dem`, row 0 in the south, metres, no holes."""

from lunar_mjx.terrain.readers.dispatch import read_dem as read_dem
