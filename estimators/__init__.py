"""Estimators for any model given as state-space functions and names; they know nothing of turbines.

What they need:

- :mod:`estimators.models.filtermodel`: f, g, names, where noise enters
- :mod:`estimators.models.sensorerrors`: gain errors, biases and lags of sensors
- :mod:`estimators.models.angles`: outputs that are read modulo a turn
- :mod:`estimators.models.recording`: time-stamped samples of any rate, with gaps
- :mod:`estimators.models.lifting`: models whose algebraic unknowns the optimiser finds
- :mod:`estimators.filters.belief`: mean and covariance of named states

Filters:

- :mod:`estimators.filters.filtering`: running a filter's step over a recording; its result
- :mod:`estimators.filters.ekf`: extended Kalman filter, plain and iterated
- :mod:`estimators.filters.ukf`: square-root unscented filter, cubature and scaled points
- :mod:`estimators.filters.imm`: several models at once, in the log domain
- :mod:`estimators.filters.adaptive`: measurement noise that is adapted from the innovations
- :mod:`estimators.filters.late`: samples as they arrive, out of sequence too
- :mod:`estimators.filters.filterpy_adapter`: our models in filterpy's filters
- :mod:`estimators.filters.algebra`: small dense algebra written out for generated code

Whole recordings:

- :mod:`estimators.batch.smoother`: fixed-interval and fixed-lag smoother for all of them
- :mod:`estimators.batch.immsmoother`: the smoother of interacting models
- :mod:`estimators.batch.mhe`: moving horizon with bounds
- :mod:`estimators.batch.fit`: batch fit with intervals
- :mod:`estimators.batch.transcription`: recordings as a sparse nonlinear program, under both
- :mod:`estimators.batch.noisefit`: noise by maximum likelihood, with its uncertainty

What can be known, and what has changed:

- :mod:`estimators.information.bounds`: posterior Cramer-Rao bounds
- :mod:`estimators.information.identifiability`: what can be known from given sensors, in words
- :mod:`estimators.detection`: tests of innovations with a false-alarm rate that they keep
"""
