"""Campaigns of the twin whose inputs lie, one lie at a time: what the command answers to each (``python -m tests.soak.lies``)."""
