"""The electrical filter: fluxes, rotor angle and turn-to-turn short circuit from 10 kHz samples.

Measured are the phase voltages and currents, field voltage and current, and the speed.  Voltages
and speed are inputs of the terminal model, currents are its outputs, so that neither load nor
exciter is modelled.  For kappa = mu (the default) a fault is h, one number for each phase: all
three are estimated, linearly and without bounds, and the faulty phase is found from them.  mu and
k_rf are then a ridge, mu = h (1 + k_rf)/(1 + h), and are reported as such.  A leaky fault
(kappa > mu) is estimated for a phase and a kappa that are given.

=============================================== ==============================================
:mod:`scenarios.estimation.electrical.tuning`   random walks, starts, levels, and why
:mod:`scenarios.estimation.electrical.signals`  what is measured, and signals of the model
:mod:`scenarios.estimation.electrical.model`    errors of voltages, gains, leaky faults, jumps
:mod:`scenarios.estimation.electrical.filter`   the filter, its recordings and its start
:mod:`scenarios.estimation.electrical.tracking` faults that come and go; mean power
:mod:`scenarios.estimation.electrical.faults`   which phase, how much, what cannot be told
=============================================== ==============================================
"""
