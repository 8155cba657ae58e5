"""Data files: gas coefficients and component maps, each with its source in the header."""
