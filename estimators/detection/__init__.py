"""Detection of changes from innovations, each test with a false-alarm rate that it keeps.

The innovations of a filter are white and of known covariance as long as its model holds.

====================================== =============================================================
:mod:`estimators.detection.alarms`     what every test says: statistic, threshold, alarms, delay
:mod:`estimators.detection.nis`        normalised innovation squared, summed over a window: any
                                       change
:mod:`estimators.detection.cusum`      Page's cumulative sum of a scalar: a shift of stated size,
                                       both signs
:mod:`estimators.detection.signatures` what jumps in states, parameters and sensors leave in the
                                       innovations
:mod:`estimators.detection.glr`        generalised likelihood ratio: such jumps, their size and
                                       onset
====================================== =============================================================

A threshold is found from the false alarms per hour that are allowed, never the other way round:
of the windowed NIS by the exact rate of up-crossings, of the cumulative sum by its exact average
run length, of the likelihood ratio by simulation with a fitted tail.

All of them stand on white, normalised innovations.  A filter that is not consistent, or whose model
is wrong, raises more alarms than stated: judge that first.
"""
