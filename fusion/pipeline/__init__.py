"""The stages of a run, from the campaign file to the report."""
