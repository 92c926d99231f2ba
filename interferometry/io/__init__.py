"""Laser and environment files as recorded (level 0), read into one Dataset of deviations, and written."""
