"""What a user writes: the campaign file, its quantities, the files it names, read and checked before the long work (level 0)."""
