"""Studies of the electrical filter: efficiency, consistency, detection, leaky faults, speed.

Truths come from the generator with load and exciter, integrated by CVODES at tolerances of 1e-9,
without noise, and are kept; noise, gain errors and random severities are drawn for each seed.  For
kappa = mu a severity h_k adds -h_k v_k/r_s to the current of phase k whatever draws that current,
and flux noise obeys the machine's linear equations: so one noise-free truth serves any number of
random courses of h and of the fluxes, exactly.

Every number that a study depends on stands in ``protocol``, fixed before it is run; filters were
tuned on the seeds below ``SEED0``.

- :mod:`scenarios.studies.electrical.protocol`: seeds, loads, cases, limits of the goals
- :mod:`scenarios.studies.electrical.truth`: noise-free courses, what sensors read
- :mod:`scenarios.studies.electrical.scores`: NEES, bands, statistics, alarms
- :mod:`scenarios.studies.electrical.efficiency`: h against its bound, consistency
- :mod:`scenarios.studies.electrical.delays`: delay, and the right phase
- :mod:`scenarios.studies.electrical.alarms`: load steps, gas faults, long operation
- :mod:`scenarios.studies.electrical.leaky`: faults with kappa > mu, a wrong kappa
- :mod:`scenarios.studies.electrical.steptime`: time of a step of EKF and UKF
"""
