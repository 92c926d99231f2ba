"""Damaged inputs of every kind, read in batches of processes that are watched from outside."""
