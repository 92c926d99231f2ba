"""Input (level 0): the campaign file, its quantities, and the files that it names, read and checked before any calculation."""
