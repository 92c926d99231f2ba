"""Which part of the temperature field drives the drift: tests, places, sensors, and schedules that establish causation."""
