"""What a run leaves behind (level 5): products on disk, typed results, progress."""
