"""Two finished runs of one machine, read together."""
