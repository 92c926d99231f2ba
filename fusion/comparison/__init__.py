"""Campaigns of one machine side by side: what changed between them by more than their uncertainties, and what cannot be compared."""
