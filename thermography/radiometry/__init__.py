"""Counts become temperatures (level 1): the camera's calibration, its uncertainty budget, emissivity and artefacts of the camera."""
