"""The estimators at work on the APU: sensors, filters of both parts, the joint one, and studies."""
