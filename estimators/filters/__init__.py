"""Recursive filters, one module each, and the belief that they carry."""
