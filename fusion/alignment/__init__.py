"""Both recordings on one clock (level 4): readings with the field at their own time."""
