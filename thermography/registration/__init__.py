"""Pixels become places on the table plan (level 2): fiducials found, projection fitted, motion and clock of the table."""
