"""Results of a run: typed parts of results.json, files on disk, contracts of Datasets, progress."""
