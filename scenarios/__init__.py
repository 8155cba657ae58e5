"""Scenarios, studies and the command line."""
