"""Recorded data files: columns, time, units, and what a reading can be."""
