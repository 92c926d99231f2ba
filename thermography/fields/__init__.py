"""Frames become one temperature field per cycle (level 3): still and moving table, hotspots, series of regions."""
