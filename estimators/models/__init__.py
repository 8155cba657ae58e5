"""What estimators need to know: a model with its noise, and recordings."""
