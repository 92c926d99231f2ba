"""Both instruments on one clock: correlation, diagnosis, the closed loop, the report and the command."""
