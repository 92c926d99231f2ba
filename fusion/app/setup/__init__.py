"""Set up: from a folder of files to a campaign file."""
