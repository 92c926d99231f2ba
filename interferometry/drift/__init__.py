"""Profile and thermal drift of an axis estimated together in real time, and the number of cycles that a test needs."""
