"""The gas generator: gas, components, maps, cycle, steady points."""
