"""Estimators for any model given as state-space functions and names; they know nothing of turbines.

=================================== ================================================================
:mod:`estimators.models.filtermodel`             what a filter needs to know: f, g, names, where
noise enters :mod:`estimators.filters.belief`            mean and covariance of named states
:mod:`estimators.models.recording`         time-stamped samples of any rate, with gaps
:mod:`estimators.filters.ekf`               extended Kalman filter, plain and iterated
:mod:`estimators.filters.ukf`               square-root unscented filter, cubature and scaled
points :mod:`estimators.filters.filtering`         running a filter's step over a recording; its
result :mod:`estimators.batch.smoother`          Rauch-Tung-Striebel smoother for all of them
:mod:`estimators.filters.imm`               several models at once, in the log domain
:mod:`estimators.batch.mhe`               moving horizon with bounds :mod:`estimators.batch.fit`
batch fit with intervals :mod:`estimators.batch.transcription`     recordings as a sparse nonlinear
program, under mhe and fit :mod:`estimators.models.lifting`           models whose algebraic
unknowns the optimiser finds :mod:`estimators.information.bounds`            posterior Cramer-Rao
bounds :mod:`estimators.information.identifiability`   what can be known from given sensors, in
words :mod:`estimators.detection`         tests of innovations with a false-alarm rate that they
keep :mod:`estimators.filters.filterpy_adapter`  our models in filterpy's filters
:mod:`estimators.filters.algebra`           small dense algebra written out for generated code
=================================== ================================================================
"""
