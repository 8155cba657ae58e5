"""Estimators for any model given as state-space functions and names (to come)."""
