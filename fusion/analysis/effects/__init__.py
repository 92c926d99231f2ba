"""The library of effects that can be missing from a model, and the candidates that each offers for a set of readings."""
