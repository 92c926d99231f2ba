"""Presentation (level 5): the report with its charts and tables, the terminal summary, exports."""
