"""What a reader sees (level 5): the report, its charts and words, the terminal summary, exports."""
