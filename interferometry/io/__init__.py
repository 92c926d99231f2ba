"""Readers and writers of laser and environment files."""
