"""Which fault is it?  Eleven classes, told apart from a few seconds around the onset.

Healthy; a loss of compressor efficiency, compressor flow, turbine efficiency, or a change of
turbine flow, each alone; both compressor factors, both turbine factors; a turn-to-turn short
circuit (TTSC); a gain error of the P3, T3 or T5 sensor.  Each of 1 to 4 %, uniformly, on a unit
that its governor holds at speed, at any load and day, with

* the sensors of :data:`estimators.apu.sensors.GAS_PATH` at 50 Hz, whose constant gain errors
  are unknown, like the wear of the engine before the fault: both are nuisances with a stated prior;
* a load that wanders, and in half of the windows makes a step, in any class;
* the electrical filter's severity h, with an unknown constant offset from sensor gains and load
  unbalance.  A TTSC takes shaft power that the measured electrical power does not show.

Two classifiers, and what no classifier can surpass:

* ``glr``: one filter of the healthy engine; each hypothesis is judged by what its jump would have
  left in the innovations (:func:`estimators.detection.glr.glr`), size and onset integrated out;
* ``bank``: one filter for each hypothesis, with the size as a state, from the onset that ``glr``
  found: linearised about the faulty engine instead of the healthy one;
* ``limit``: Bayes' rule in the linear problem with Gaussian noise, by Monte Carlo: there the first
  classifier is exact and none is better.

All integrate the sizes out over the very range that they are drawn from, so a pair does not win
against its members by having more freedom.

- :mod:`estimators.apu.isolation.problem`: classes, protocol of a window
- :mod:`estimators.apu.isolation.windowmodel`: the gas path with jumps
- :mod:`estimators.apu.isolation.truth`: simulated windows of the governed unit
- :mod:`estimators.apu.isolation.evidence`: sizes integrated out over their ranges
- :mod:`estimators.apu.isolation.classifiers`: ``glr`` and ``bank``
- :mod:`estimators.apu.isolation.scores`: confusion matrix, Cohen's kappa
- :mod:`estimators.apu.isolation.limit`: Bayes' rule in the linear problem
- :mod:`estimators.apu.isolation.sklearnbank`: the classifiers as one of scikit-learn
- :mod:`scenarios.studies.estimation.isolation`: fresh windows of every class
"""
