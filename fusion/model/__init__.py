"""A model of the drift: profile, effects and a drift of its own, fitted by generalised least squares (level 4)."""
