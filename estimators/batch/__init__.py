"""Estimates from whole recordings: smoothers, moving horizons, fits."""
