"""Model of the drift and the closed loop, of an axis and of a record: fit, search, tests, admissibility, hold-out, result."""
