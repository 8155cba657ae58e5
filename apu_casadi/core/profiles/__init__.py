"""Profiles: numbers that change in time, one kind a class."""
