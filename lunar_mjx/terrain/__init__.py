"""Terrains: height fields sampled on the device, DEM readers, procedural detail, rocks and soil maps."""
