"""Results: the products of a run, linked: a cycle or a position that is chosen anywhere is shown everywhere."""
