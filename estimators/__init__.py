"""Estimators for any model given as state-space functions and names; they know nothing of turbines.

=================================== ================================================================
:mod:`estimators.model`             what a filter needs to know: f, g, names, where noise enters
:mod:`estimators.belief`            mean and covariance of named states
:mod:`estimators.recording`         time-stamped samples of any rate, with gaps
:mod:`estimators.ekf`               extended Kalman filter, plain and iterated
:mod:`estimators.ukf`               square-root unscented filter, cubature and scaled points
:mod:`estimators.filtering`         running a filter's step over a recording; its result
:mod:`estimators.smoother`          Rauch-Tung-Striebel smoother for all of them
:mod:`estimators.imm`               several models at once, in the log domain
:mod:`estimators.mhe`               moving horizon with bounds
:mod:`estimators.fit`               batch fit with intervals
:mod:`estimators.transcription`     recordings as a sparse nonlinear program, under mhe and fit
:mod:`estimators.lifting`           models whose algebraic unknowns the optimiser finds
:mod:`estimators.bounds`            posterior Cramer-Rao bounds
:mod:`estimators.identifiability`   what can be known from given sensors, in words
:mod:`estimators.detection`         tests of innovations with a false-alarm rate that they keep
:mod:`estimators.filterpy_adapter`  our models in filterpy's filters
:mod:`estimators.algebra`           small dense algebra written out for generated code
=================================== ================================================================
"""
