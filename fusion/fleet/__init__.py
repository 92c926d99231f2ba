"""Many campaigns in one command: one process for each, and one table of what they found."""
