"""Times against their targets, with the accuracy of every answer."""
