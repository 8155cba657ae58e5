"""Faults of the machine, one module each."""
