"""The test by ISO 230-2 as a run and as the command `iso230` evaluate it."""
