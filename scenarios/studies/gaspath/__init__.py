"""Studies of the gas-path filter: efficiency, consistency, and what the shaft power adds.

Everything that was tuned, was tuned on the seeds ``TUNED``; what is shown comes from ``FRESH``; the
iteration was chosen on ``TUNED_LONG``.

Matched truth is made by the filter's own model
(:class:`~scenarios.studies.gaspath.enginetruth.MatchedTruth`): health factors walk, speed has its
process noise, the factors jump at 6 s by the law that the filter assumes, and it is told when.
Mismatched truth (:class:`~scenarios.studies.gaspath.enginetruth.EngineTruth`) has another
integrator (linearly implicit, warm start), steps of 5 ms, a governor that acts in between, another
engine (``VARIANTS``: inertia, gas data, map calibration), faults of 1-4 % in one to four factors,
sensor gains and generator efficiency off; the filter must find the jump itself.

============ =====================================================================
course       seeds, instants, engines, what is drawn for a seed
enginetruth  matched and mismatched truths
chance       what chance alone gives: the exact filter of the linearised model
montecarlo   efficiency and consistency over many seeds
methods      EKF, UKF, smoother on the same data
powerworth   filters with and without shaft power
============ =====================================================================
"""
