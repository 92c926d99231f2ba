"""Live: a test that is still running, cycle by cycle, and whether its cycles are enough."""
