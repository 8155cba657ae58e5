"""The estimators at work on the APU: sensors, recordings, filters of both parts, isolation."""
