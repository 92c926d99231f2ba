"""Profile and drift of the axis estimated together in real time (level 3), and the number of cycles that a test needs."""
