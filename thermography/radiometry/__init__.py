"""Converts counts to temperature: calibration, uncertainty budget, emissivity, averaging, and artefacts of the camera."""
