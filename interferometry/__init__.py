"""Laser-interferometer files to compensated deviations, drift-free statistics and anomalies."""
