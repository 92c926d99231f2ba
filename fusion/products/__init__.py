"""Products of a run (level 5): files on disk, typed results, contracts of Datasets, progress."""
