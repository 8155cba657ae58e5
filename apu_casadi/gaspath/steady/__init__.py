"""Steady points of the gas generator: any two quantities fixed, one at a time or many."""
