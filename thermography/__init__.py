"""FLIR files to counts, temperature, table plan and one temperature field per measurement cycle."""
