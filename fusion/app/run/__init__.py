"""Run: the pipeline in a process of its own, watched from the page."""
