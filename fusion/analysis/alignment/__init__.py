"""Both recordings on one clock: readings with the temperature field at their own time."""
