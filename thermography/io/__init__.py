"""Frames of many files without their pixels: one object per frame, or columns for the frames of a long sequence."""
