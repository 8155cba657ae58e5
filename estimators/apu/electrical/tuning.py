"""What the electrical filter is tuned by: random walks, starts, levels, each with its reason."""

from __future__ import annotations

from apu_casadi.machine.terminals import FLUXES, SHUNTS

__all__ = [
    "ANGLE_WALK_CONSIDERED",
    "DELAY_SIGMA",
    "FAULT_LEVEL",
    "FLUX_WALK",
    "GROWTH_LEVEL",
    "GROWTH_SPANS",
    "HARMONIC_PERIODS",
    "H_BALANCED",
    "H_BALANCED_CONSIDERED",
    "H_COMMON_TIME",
    "H_SIGMA",
    "H_STRAIGHT",
    "H_WALK",
    "H_WALK_CONSIDERED",
    "H_WALK_GAINS",
    "JUMP",
    "JUMP_SHARE",
    "LEAKY_START",
    "LEAKY_WALK",
    "LEAST_SUSCEPTANCE",
    "MOTION_SEEN",
    "ONSET_LEVEL",
    "RATE_MEMORY",
    "RATE_SIGMAS",
    "RELEASE_LEVEL",
    "RESETS_WITHIN",
    "RESET_LEVEL",
    "RESET_SIGMA",
    "RESET_WINDOW",
    "REST_LEVEL",
    "REST_SPAN",
    "SMOOTH_LIMIT",
    "START_SIGMA",
    "START_SIGMA_SHUNT",
    "STEEP",
]

#: Random walk of each h, 1/sqrt(s).  A sample tells h to some 3e-5 (225 kW), so the filter averages
#: over about 25 ms and claims 3e-6.
H_WALK = 2e-5
#: The same with gain errors: they leave h uncertain by 4e-5 in any case, so h may as well move
#: fast; with the slow walk a fault would be taken for a change of the gains found before it.
H_WALK_GAINS = 2e-4
#: The same where they are considered and all three h are states: what they have in common walks
#: too.
H_WALK_CONSIDERED = 5e-5
#: Random walk of both parts of a leaky fault's admittance, 1/sqrt(s): slower than h, since what
#: tells mu from k_rf is a small share of it; the filter averages over 60 ms.
LEAKY_WALK = 5e-6
#: Random walk of the flux linkages, Wb/sqrt(s): 1e-6 Wb in a step of 100 us, 0.03 A; stands for
#: what the interpolation of the voltages leaves.
FLUX_WALK = 1e-4
#: Random walk of the rotor angle where gains are considered, rad/sqrt(s): as much as a speed that
#: is 1 rad/s off for 10 ms.  A turned angle looks like gain errors, which that filter leaves alone,
#: so it hardly corrects the angle: a speed 1 rad/s off (its noise is 1.25) for a tenth of a second
#: after a load step turned it by 0.06 rad and moved all h by 7e-4, their statistics by three
#: standard deviations; with the walk it is 3e-5 and 0.2.  The price is nil: one h with the others
#: zero is known to 4.0e-5 at 225 kW and 2.4e-5 at 100 kW, as without it.
ANGLE_WALK_CONSIDERED = 0.1
#: Standard deviation of the delay of the current sensors behind those of the voltages, s: 0.72
#: degrees at 400 Hz, between the phase displacements that classes 0.5 and 1 of IEC 61869-2 allow
#: (30 and 60 minutes).
DELAY_SIGMA = 5e-6
#: Start of a leaky fault: mean of both parts of its admittance, and what its current (A, standard
#: deviation) has beside that of the admittance.
LEAKY_START = 3e-3
START_SIGMA_SHUNT = 5.0
#: Least susceptance of a leaky fault: without one it has no current of its own.
LEAST_SUSCEPTANCE = 1e-6
#: Electrical periods over which the harmonics of the voltages are averaged: their noise lasts as
#: long in the middles of the steps, and over two periods it is 0.5 % of what the filter expects.
HARMONIC_PERIODS = 10.0
#: Jumps of the voltage within a step up to this, V, are taken for noise: five standard deviations.
JUMP = 5.0
#: Unknown mean voltage of a step with a jump, over the jump's size; the jump's instant alone gives
#: 0.3, the overshoot of a resistive load that is dropped gives the rest.
JUMP_SHARE = 1.0
#: A reading further from its prediction than this many standard deviations is taken itself.
SMOOTH_LIMIT = 6.0
#: Standard deviations of the start: stator and rotor fluxes (Wb), angle (rad), of a healthy
#: machine; what an h adds to them goes with h.  With 0.03 rad the linearisation shows in the NEES.
START_SIGMA = {
    "lam_sq": 1.5e-3,
    "lam_sd": 1.5e-3,
    "lam_s0": 5e-4,
    "lam_fd": 1.5e-3,
    "lam_kd": 1.5e-3,
    "lam_kq": 1.5e-3,
    "theta_e": 0.01,
}
#: Standard deviation of a free parameter of the machine at the start, of its value.
FREE_SIGMA = 0.1
#: Standard deviation of each h at the start.
H_SIGMA = 1e-2
#: Severity up to which a start about a healthy machine is straight enough: one of 1e-2 turns the
#: rotor by a tenth of a radian, ten standard deviations, which that start does not follow.
H_STRAIGHT = 1e-3
#: That of what all three have in common, times sqrt(3): a balanced short circuit is a load that
#: the rotor angle alone tells from one.  With ``H_SIGMA`` for it the angle starts 1 rad uncertain,
#: far beyond where the model is linear: at 10 kW errors were 12 claimed standard deviations.  A
#: fault in one phase has a third of its h in common, which this hardly holds back.  With a tenth of
#: it at a reset, h = 1e-2 at 100 kW was 1 to 1.5 % short for 50 ms, 3 to 6 claimed deviations: the
#: filter is linearised about another angle.  With this the errors are 0.8 to 1.3 claimed deviations
#: from 2 to 200 ms after the onset (RMS, seeds 6 to 17, gains drawn, estimated or considered).
H_BALANCED = 1e-3
#: The same where gains are considered, and after a reset too where a power is made of the
#: severities: noise in the derivatives by angle and h makes that filter learn of it what is not
#: there, and with 1e-3 a healthy machine at 50 kW was at -2e-3 in all three phases after 1.6 s, 17
#: claimed standard deviations.  It holds a fault in one phase back by a per cent, until it is found
#: and has a filter of its own.
H_BALANCED_CONSIDERED = 1e-4
#: Time in which what all three have in common goes to that of one faulty phase, s, where gains are
#: considered.  What the filter learns of it from noise in its derivatives is the square of its
#: standard deviation times 4e4 a second at 100 and 225 kW: with a walk alone a healthy machine was
#: at -1.4e-3, fourteen claimed deviations, after 4 s, and began anew every half second from 5 s on.
#: With this it stays within 3e-5 claimed, and is at -1e-5; with 0.1 s a severe fault has less time
#: to be told before it is held back.
H_COMMON_TIME = 0.5
#: A step of h is looked for in windows of this many samples (5 ms) ...
RESET_WINDOW = 50
#: ... whose mean NIS exceeds this; 4 is expected, 8 is ten standard deviations more.
RESET_LEVEL = 8.0
#: Time, s, in which no machine changes so often that its filter begins anew twenty times: a fault
#: that comes and goes five times a second makes fifteen.
RESETS_WITHIN = 1.5
#: NIS of one sample from which a change is told to be there: noise passes it once in 3e7 samples.
#: With gains considered, whose offsets stay in the innovations, once in 1.1e7 healthy ones (1 of
#: 11.5e6 in 115 runs of 10 s with drawn gains at 10 to 225 kW; 95 %: 2e6 to 4e8), and so before the
#: onset of one reset in 1e5.
ONSET_LEVEL = 40.0
#: What is added to the standard deviations at a reset.
RESET_SIGMA = {
    **dict.fromkeys(SHUNTS.names, 1e-2),
    **dict.fromkeys(FLUXES.names, 1e-3),
    **dict.fromkeys(("g_shunt", "b_shunt"), 1e-2),
    "i_shunt": 50.0,
}
#: A severity moves where what it moved by over one of these numbers of samples has a normalised
#: square above this: of noise 25 is passed by none in 150 s of healthy operation, 20 once in 8 s.
GROWTH_SPANS = (15, 30, 60, 120, 250, 500, 1000)
GROWTH_LEVEL = 22.0
#: It may be behind a motion from this on: in noise 0.5 % of the instants.  The growth by 0.016 a
#: second is 14 claimed standard deviations ahead by then, which no earlier level of a filter as
#: sharp avoids, and 25 where it is certain.
MOTION_SEEN = 9.0
#: It rests where over this many samples it has moved by less than this times its variances.
REST_SPAN = 1000
REST_LEVEL = 4.0
#: Rates of severities that grow, 1/s: the standard deviation of slow and of steep ones, the least
#: of the latter, and the time over which a rate lasts, s.  Slow ones leave a severity as well known
#: as a constant one but for a quarter.
RATE_SIGMAS = (0.002, 0.02)
STEEP = 0.003
RATE_MEMORY = 0.5
#: Statistic (h/sigma)^2 of one phase above which a fault is reported: five standard deviations.
#: The rule: by the tail of the tuning runs, continued as a Gaussian's, less than one false alarm an
#: hour, and less than 1e-4 in a run of two load steps.  Noise passes it less than once in ten hours
#: (Rice's formula through the counts at lower levels), constant gain errors in one steady unit of a
#: million.  Load steps and gas faults, with and without gain errors, pass it in 1e-5 to 3e-5 of the
#: runs (200 tuning seeds of each kind, largest statistic 4.1 standard deviations).
FAULT_LEVEL = 25.0
#: Statistic of the phase found faulty below which it no longer is: three standard deviations.
RELEASE_LEVEL = 9.0
