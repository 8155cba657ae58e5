"""Studies: the estimators and the exchange on trial over many random runs."""
