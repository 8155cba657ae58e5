"""Data sets of many units with labels, and their scorer."""
