"""Compare: campaigns of one machine over months, and what changed by more than the uncertainties."""
