"""The whole unit: gas generator, generators, governor, their exchange, and runs of all of it."""
