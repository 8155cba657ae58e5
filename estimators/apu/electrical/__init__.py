"""The electrical filter: fluxes, rotor angle and turn-to-turn short circuit from 10 kHz samples.

Measured are the phase voltages and currents, field voltage and current, and the speed.  Voltages
and speed are inputs of the terminal model, currents are its outputs, so that neither load nor
exciter is modelled.  For kappa = mu (the default) a fault is h, one number for each phase: all
three are estimated, linearly and without bounds, and the faulty phase is found from them.  mu and
k_rf are then a ridge, mu = h (1 + k_rf)/(1 + h), and are reported as such.  A leaky fault
(kappa > mu) is estimated for a phase and a kappa that are given.

- :mod:`estimators.apu.electrical.tuning`: random walks, starts, levels, and why
- :mod:`estimators.apu.electrical.terminalsignals`: what is measured, and signals of the model
- :mod:`estimators.apu.electrical.machinemodel`: errors of voltages, gains, leaky faults, jumps
- :mod:`estimators.apu.electrical.electricalfilter`: the filter, its recordings and its start
- :mod:`estimators.apu.electrical.tracking`: faults that come and go; mean power
- :mod:`estimators.apu.electrical.growing`: faults that grow
- :mod:`estimators.apu.electrical.faults`: which phase, how much, what cannot be told
- :mod:`estimators.apu.electrical.hypotheses`: a short circuit that may be there
- :mod:`estimators.apu.electrical.electricalside`: what is handed to the gas path
"""
