"""The simulated machine: schedule, heat, air, drift and effects, known exactly."""
