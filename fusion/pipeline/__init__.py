"""A run as a list of stages, from the campaign file to the report; watch, fleet, check and init use the same list."""
