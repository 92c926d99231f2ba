"""Temperature fields on the table plan, one per measurement cycle, from frames of a still or a moving table; hotspots and regions."""
