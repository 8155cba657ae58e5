"""Electrical loads, one module each."""
