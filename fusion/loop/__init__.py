"""The closed loop (level 4): search for the missing effect, test, admissibility, hold-out, result."""
