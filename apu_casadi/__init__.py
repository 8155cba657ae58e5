"""Joint fault models of all-electric auxiliary power units."""
