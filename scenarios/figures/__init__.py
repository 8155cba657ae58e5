"""All figures; nothing else draws."""
