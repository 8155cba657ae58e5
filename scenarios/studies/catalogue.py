"""The estimation studies by name: running them, keeping what is done, and reading it again.

A study has parts.  Each part is written as soon as it is done, so that an interruption loses one
part and no more; a part that was run with the same seeds and the same constants is not run again.
Where its filters have changed since, :func:`other_code` says so.
What is claimed of the results, figures and text are in :mod:`scenarios.pages.reports`.

>>> from scenarios.studies import catalogue
>>> studies.run("correctness", "results", n_seeds=20)  # doctest: +SKIP
"""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from apu_casadi.core.errors import DataError, ParameterError, nearest
from scenarios.shell.locking import locked
from scenarios.shell.markdown import write_text
from scenarios.studies import kept
from scenarios.studies.fingerprint import digest
from scenarios.studies.gaspath_study import FRESH, TUNED, TUNED_LONG

__all__ = [
    "STUDIES",
    "Part",
    "Results",
    "Study",
    "get",
    "other_code",
    "pending",
    "read",
    "results",
    "run",
]

Tell = Callable[[int, int], None]
"""Called with what is done of a part, and its total, in any unit."""

PACKAGES = ("apu-casadi", "casadi", "numpy", "scipy", "filterpy")
DIGITS = 6  # significant digits that are kept of a number


@dataclass(frozen=True)
class Part:
    """One run of a study.

    Args:
        run: (n_seeds, seed0, tell) -> numbers that JSON can hold.
        start, each: expected seconds on one core: once, and for each seed of the study.
        share: seeds of this part over those of the study; None: it has no seeds.
    """

    run: Callable[[int, int, Tell], Any]
    start: float
    each: float
    share: float | None = 1.0

    def seeds(self, n: int) -> int:
        """Return how many of the study's seeds this part takes; two at least, or none."""
        return 0 if self.share is None else max(2, round(self.share * n))

    def seconds(self, n: int) -> float:
        """Return the expected duration with the study's n seeds, s, on one core."""
        return self.start + self.each * n


@dataclass(frozen=True)
class Study:
    """One study.

    Args:
        name: on the command line, and of its file.
        title: heading of its section.
        goal: what is to be shown, with the number.
        parts: by name, in order.
        modules: whose constants fix it: all numbers in capitals; keys of ``MODULES``.
        seeds, seed0: default number of fresh seeds, and the first of them.
        tuned: on which seeds the filters and thresholds were tuned.
    """

    name: str
    title: str
    goal: str
    parts: Mapping[str, Part]
    modules: tuple[str, ...]
    seeds: int = 500
    seed0: int = 1000
    tuned: str = "nothing is tuned"

    def fixed(self) -> dict[str, Any]:
        """Return the constants that the results depend on, by module, and the sensor tables."""
        from estimators.apu.sensors import ELECTRICAL, GAS_PATH

        out = {m: constants(*MODULES[m]) for m in self.modules}
        if out:
            out["sensors"] = {
                s.name: [s.noise, s.gain] for s in (*GAS_PATH.sensors, *ELECTRICAL.sensors)
            }
        return _plain(out)


MODULES = {
    "electrical": ("estimators.apu.electrical",),
    "electrical_study": ("scenarios.studies.electrical",),
    "fitting": ("estimators.apu.fitting",),
    "gaspath": ("estimators.apu.gaspath",),
    "gaspath_study": ("scenarios.studies.gaspath_study",),
    "identify": ("estimators.apu.identify",),
    "isolation": ("estimators.apu.isolation", "scenarios.studies.isolation_study"),
    "joint": ("estimators.apu.joint",),
}
"""Modules or packages whose constants fix a study, by the name under which they are kept."""


def constants(*modules: str) -> dict[str, Any]:
    """Return the constants in capitals that JSON can hold, of modules and of packages' modules."""
    names: list[str] = []
    for module in modules:
        inner = iter_modules(getattr(import_module(module), "__path__", []), f"{module}.")
        names += [module, *(m.name for m in inner)]
    found: dict[str, Any] = {}
    for space in (vars(import_module(name)) for name in names):
        for name, value in space.items():
            if re.fullmatch(r"[A-Z][A-Z0-9_]*", name):
                try:
                    json.dumps(value, allow_nan=False)
                except (TypeError, ValueError):
                    continue
                found[name] = value
        # what a test of jumps is made of, where there is one
        for name in ("JUMP_TEST", "TEST", "DEFAULT", "SNAPSHOT"):
            value = space.get(name)
            if dataclasses.is_dataclass(value) and not isinstance(value, type):
                found[name] = {
                    f.name: v for f in dataclasses.fields(value)
                    if isinstance(v := getattr(value, f.name), int | float | str | tuple)
                }  # fmt: skip
    return found


def _plain(x: Any) -> Any:
    """Return what JSON holds: numbers with few digits, no NaN, no infinity, no tuples."""
    if isinstance(x, Mapping):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, bool) or x is None or isinstance(x, int | str):
        return x
    if hasattr(x, "tolist"):
        return _plain(x.tolist())
    if isinstance(x, float):
        return float(f"{x:.{DIGITS}g}") if math.isfinite(x) else None
    raise DataError(f"a study returned {type(x).__name__}, which JSON cannot hold")


# ------------------------------------------------------------------------------ the parts


def _correctness(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies.correctness import correctness

    return correctness(n, seed0, progress=tell)


def _efficiency(case: str) -> Callable[[int, int, Tell], Any]:
    def run(n: int, seed0: int, tell: Tell) -> Any:
        from scenarios.studies.electrical.efficiency import efficiency

        return efficiency(n, seed0, cases=[case])[case]

    return run


def _detection(case: str) -> Callable[[int, int, Tell], Any]:
    def run(n: int, seed0: int, tell: Tell) -> Any:
        from scenarios.studies.electrical.detection import detection

        return detection(n, seed0, cases=[case])[case]

    return run


def _leaky(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies.electrical.leaky import leaky

    return leaky(n, seed0)


def _ridge(n: int, seed0: int, tell: Tell) -> Any:
    from estimators.apu import severity

    rows = []
    for s in severity.severity_study():
        row = dataclasses.asdict(s)
        row["fault"] = {"mu": s.fault.mu, "k_rf": s.fault.k_rf, "kappa": s.fault._kappa}
        rows.append(row)
    return {"rows": rows}


def _quiet(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies.electrical.false_alarms import quiet

    return quiet(n, seed0)


HOURS_PER_SEED = 0.002  # an hour for 500
MONOLITHIC = 0.4  # s


def _false_alarms(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies.electrical.false_alarms import false_alarms

    return false_alarms(HOURS_PER_SEED * n, seed0)


def _gaspath(matched: bool) -> Callable[[int, int, Tell], Any]:
    def run(n: int, seed0: int, tell: Tell) -> Any:
        from scenarios.studies import gaspath_study as study

        return study.efficiency(range(seed0, seed0 + n), matched=matched)

    return run


def _filters(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies import gaspath_study as study

    return {"rows": study.compare_filters(range(seed0, seed0 + n))}


def _power_snapshot(n: int, seed0: int, tell: Tell) -> Any:
    from estimators.apu import identify

    return {
        "priors": list(identify.PRIORS),
        "rows": identify.snapshot_sweep(power_noises=(0.01,)),
        "limiting_gains": identify.limiting_gains(eta_bias=identify.ETA_BIAS),
        "limiting_noises": identify.limiting_noises(prior=identify.PRIOR),
        "needed_samples": {
            label: identify.needed_samples(aim, prior=identify.PRIOR, **identify.VARIANTS[label])
            for label, aim in identify.AIMS.items()
        },
    }


def _power_trials(n: int, seed0: int, tell: Tell) -> Any:
    from estimators.apu import identify, trials

    return {
        label: dataclasses.asdict(
            trials.snapshot_trials(seeds=range(seed0, seed0 + n), **identify.VARIANTS[label])
        )
        for label in identify.AIMS
    }


def _power_sweep(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies import gaspath_study as study

    return study.shaft_power()


def _power_filter(gains: bool, bias: bool) -> Callable[[int, int, Tell], Any]:
    def run(n: int, seed0: int, tell: Tell) -> Any:
        from scenarios.studies import gaspath_study as study

        return study.shaft_power_seeds(
            range(seed0, seed0 + n), gains=gains, eta=study.ETA_SIGMA if bias else None
        )

    return run


WRONG_KEPT = 20  # wrong answers of the isolation that are kept


def _isolation(name: str) -> Callable[[int, int, Tell], Any]:
    def run(n: int, seed0: int, tell: Tell) -> Any:
        from apu_casadi.gaspath.gasgenerator import GasGenerator
        from scenarios.studies import isolation_study

        protocol, other = isolation_study.STUDIES[name]
        gg = GasGenerator()
        engines = (
            [isolation_study.variant(gg, c) for c in isolation_study.VARIANTS.values() if c]
            if other
            else []
        )
        out = isolation_study.isolation_study(
            n, seed0, protocol, gg=gg, truth=engines, progress=tell
        )
        out["n_wrong"], out["wrong"] = len(out["wrong"]), out["wrong"][:WRONG_KEPT]
        return out

    return run


def _isolation_sweeps(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies import isolation_study

    return {
        name: isolation_study.sweep(changes, seed=seed0, protocol=protocol)
        for name, protocol, changes in isolation_study.SWEEPS
    }


def _fitting(kind: str) -> Callable[[int, int, Tell], Any]:
    def run(n: int, seed0: int, tell: Tell) -> Any:
        from estimators.apu.fitting import coverage

        return coverage(n, seed0=seed0, kind=kind, progress=tell)

    return run


def _joint_example(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies.jointrun import estimate, saved, truth

    ds = truth("joint", progress=lambda done, total: tell(int(1e3 * done), int(1e3 * total)))
    return saved(estimate(ds, seed0))


def _joint_cross_talk(n: int, seed0: int, tell: Tell) -> Any:
    from estimators.apu.joint import cross_talk
    from scenarios.studies.jointrun import truth

    return cross_talk(truth("joint"), range(seed0, seed0 + n))


def _joint_monolithic(n: int, seed0: int, tell: Tell) -> Any:
    from apu_casadi.machine.loads.load import SeriesLoad
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.events import LoadChange
    from apu_casadi.unit.multirate import simulate_joint
    from estimators.apu.monolithic_filter import compare_monolithic

    full, part = (SeriesLoad.from_power(P) for P in (225e3, 100e3))
    ds = simulate_joint(
        Apu(), duration=MONOLITHIC, load=full, events=[LoadChange(MONOLITHIC / 2, part)], dt=0.005,
        exchange="corrected", waveform_dt=1e-4,
    )  # fmt: skip
    return {"duration": MONOLITHIC, "seed": seed0, "compared": compare_monolithic(ds, seed0)}


def _step_times(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.shell.computer import machine
    from scenarios.studies.electrical.speed import speed
    from scenarios.studies.timing import filterpy_step_us

    where = machine()
    out = speed()
    out["filterpy_ukf_us"] = filterpy_step_us()
    out["machine"] = {k: where[k] for k in ("processor", "cores", "system", "load_before")}
    return out


def _joint_time(n: int, seed0: int, tell: Tell) -> Any:
    from scenarios.studies.timing import joint_seconds

    return joint_seconds()


# ------------------------------------------------------------------------------ the registry

_EL = ("electrical", "electrical_study")
_GP = ("gaspath", "gaspath_study")
_BELOW = "tuned on seeds below the first"
_GP_SEEDS: dict[str, Any] = {
    "seeds": len(FRESH), "seed0": FRESH.start,
    "tuned": f"tuned on seeds {TUNED.start} to {TUNED.stop - 1}, the iteration on "
    f"{TUNED_LONG.start} to {TUNED_LONG.stop - 1}",
}  # fmt: skip

_ALL = (
    Study(
        "correctness", "Correctness on linear models",
        "On linear models EKF, UKF, moving horizon and smoother equal the Kalman filter and batch "
        "least squares to 1e-9; agreement with filterpy.",
        {"linear": Part(_correctness, 5, 0.03)}, (),
    ),
    Study(
        "electrical", "The electrical filter at 10 kHz",
        "RMSE of h at most 1.2 times the posterior Cramer-Rao bound with the matched model, 1.5 "
        "times with the mismatched one; mean NEES and NIS in their 95 % bands at 90 % or more of "
        "the checkpoints.",
        {
            "matched": Part(_efficiency("matched"), 10, 0.035),
            "fault": Part(_efficiency("fault"), 10, 0.03),
            "constant": Part(_efficiency("constant"), 10, 0.03),
            "gains": Part(_efficiency("gains"), 15, 0.065),
            "gains, two passes": Part(_efficiency("gains, two passes"), 20, 0.5),
            "gains considered": Part(_efficiency("gains considered"), 15, 0.065),
            "gains ignored": Part(_efficiency("gains ignored"), 1, 0.03),
            "leaky": Part(_leaky, 20, 0.07, share=0.1),
            "ridge": Part(_ridge, 2, 0, share=None),
        },
        _EL, seed0=13_000, tuned=_BELOW,
    ),
    Study(
        "detection", "Detection of a short circuit",
        "h = 1e-4 found within 20 electrical periods, h = 3e-4 within 50 with gain errors and "
        "unbalance; at most one false alarm an hour; load steps and gas faults raise none.",
        {
            "matched": Part(_detection("matched"), 5, 0.02),
            "mismatched": Part(_detection("mismatched"), 15, 0.075),
            "quiet": Part(_quiet, 15, 2.4),
            "false alarms": Part(_false_alarms, 2, 0.6),
        },
        _EL, seed0=12_000, tuned="tuned on seeds below 10000; 10000 to 10499 were looked at before",
    ),
    Study(
        "gaspath", "The gas-path filter at 20 ms",
        "RMSE of the four health factors at most 1.2 times the posterior Cramer-Rao bound with the "
        "matched model, 1.5 times with the mismatched one; mean NEES and NIS in their 95 % bands "
        "at 90 % or more of the checkpoints, the null direction included: claimed variance never "
        "falls below what the information allows.",
        {
            "matched": Part(_gaspath(True), 20, 0.3),
            "mismatched": Part(_gaspath(False), 40, 0.33),
            "filters": Part(_filters, 40, 0.18, share=0.1),
        },
        _GP, **_GP_SEEDS,
    ),
    Study(
        "shaft-power", "What the shaft power is worth",
        "With a 2 % prior and 1 % power noise, shaft power takes 50 % off the error of the four "
        "health factors, 30 % with the efficiency bias of the generators.",
        {
            "snapshot": Part(_power_snapshot, 10, 0, share=None),
            "trials": Part(_power_trials, 1, 0.012),
            "sweep": Part(_power_sweep, 25, 0, share=None),
            "filter": Part(_power_filter(False, False), 5, 0.09),
            "filter, bias": Part(_power_filter(False, True), 5, 0.09),
            "filter, gain errors": Part(_power_filter(True, False), 5, 0.09),
            "filter, bias and gain errors": Part(_power_filter(True, True), 5, 0.09),
        },
        (*_GP, "identify"), **_GP_SEEDS,
    ),
    Study(
        "isolation", "Which fault is it?",
        "Healthy, four single gas faults, two pairs, a short circuit and three sensor faults of 1 "
        "to 4 %: Cohen's kappa of 0.8 or more, the information limit beside it.",
        {
            "watched": Part(_isolation("watched"), 35, 0.42, share=0.1),
            "watched, another engine": Part(
                _isolation("watched, another engine"), 35, 0.42, share=0.1
            ),
            "no history": Part(_isolation("no history"), 35, 0.42, share=0.1),
            "no history, baseline known to 0.3": Part(
                _isolation("no history, baseline known to 0.3"), 35, 0.42, share=0.1
            ),
            "sweeps": Part(_isolation_sweeps, 120, 0, share=None),
        },
        ("isolation",), seed0=1000, tuned="chosen on seeds 1 to 99",
    ),
    Study(
        "fitting", "Fitting health factors to recorded data",
        "95 % intervals hold the truth in 93 to 97 % of 500 fits.",
        {
            "steady": Part(_fitting("steady"), 2, 0.02),
            "transient": Part(_fitting("transient"), 8, 0.1),
            "steady, gains considered": Part(_fitting("steady, gains considered"), 2, 0.02),
            "steady, gains ignored": Part(_fitting("steady, gains ignored"), 2, 0.02),
        },
        ("fitting",), seed0=20_000,
    ),
    Study(
        "joint", "Both together along the paper's joint scenario",
        "The loss of a short circuit is not taken for a gas-path fault, nor the other way round.",
        {
            "example": Part(_joint_example, 30, 0, share=None),
            "monolithic": Part(_joint_monolithic, 60, 0, share=None),
            "cross-talk": Part(_joint_cross_talk, 20, 1.5, share=0.1),
        },
        (*_EL[:1], *_GP[:1], "joint"), seed0=1000, tuned="tuned as the two filters are",
    ),
    Study(
        "speed", "Speed",
        "A step of the electrical UKF takes at most 20 us and of the EKF at most 5 us, generated "
        "to C; the joint estimation of 14 s at most 5 s on one core.",
        {
            "steps": Part(_step_times, 60, 0, share=None),
            "joint": Part(_joint_time, 60, 0, share=None),
        },
        (),
    ),
)  # fmt: skip

STUDIES: dict[str, Study] = {s.name: s for s in _ALL}
"""All studies by name, in the order of the page."""


def get(name: str) -> Study:
    """Return a study.

    Raises:
        ParameterError: unknown name; the nearest is named.
    """
    if name not in STUDIES:
        raise ParameterError(f"unknown study {name!r} {nearest(name, STUDIES)}")
    return STUDIES[name]


# ------------------------------------------------------------------------------ running


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that the numbers depend on."""
    out = {"Python": platform.python_version()}
    for p in PACKAGES:
        try:
            out[p] = version(p)
        except PackageNotFoundError:
            continue
    return out


def path_of(study: Study, folder: str | Path) -> Path:
    """Return where a study is kept."""
    return Path(folder) / f"{study.name}.json"


def read(study: Study, folder: str | Path) -> dict[str, Any]:
    """Return the kept record of a study: ``fixed`` constants, and by part settings and ``result``.

    An empty record if there is none; damaged parts are left out, and told.

    Raises:
        DataError: the file cannot be read, or is none of ours.
    """
    record = kept.read(path_of(study, folder), study.name)
    return {"study": study.name, "fixed": {}, "parts": {}} if record is None else record


@dataclass(frozen=True)
class Results(Mapping[str, Any]):
    """Results of a study by part, and the seeds that each was made with.

    Args:
        parts: as they are kept in a record.
    """

    parts: Mapping[str, Mapping[str, Any]]

    def __getitem__(self, part: str) -> Any:
        return self.parts[part]["result"]

    def __iter__(self) -> Iterator[str]:
        return iter(self.parts)

    def __len__(self) -> int:
        return len(self.parts)

    def seeds_from(self, part: str) -> str:
        """Return number and first of a part's seeds, in words."""
        first, n = self.parts[part]["seeds"]
        return f"{n} from {first}"

    def seeds_to(self, part: str) -> str:
        """Return first and last of a part's seeds, in words."""
        first, n = self.parts[part]["seeds"]
        return f"{first} to {first + n - 1}"


def results(record: Mapping[str, Any]) -> Results:
    """Return the results of a record by part."""
    return Results(record["parts"])


def pending(study: Study, folder: str | Path, n_seeds: int) -> list[str]:
    """Return the parts that are not kept in ``folder`` with these seeds and today's constants."""
    record = read(study, folder)
    if record["fixed"] != study.fixed():
        return list(study.parts)
    return [
        name
        for name, part in study.parts.items()
        if record["parts"].get(name, {}).get("seeds") != _settings(study, part, n_seeds)
    ]


def other_code(study: Study, record: Mapping[str, Any]) -> str:
    """Say which parts of a record were made with other filters than the code makes now; or "".

    A part with other seeds or constants is pending and run again; one made with other code is not,
    since a change of the code may well leave the numbers as they are.  See
    :mod:`scenarios.studies.fingerprint`.
    """
    other, unknown = [], []
    for name, part in record["parts"].items():
        if "code" not in part or part["versions"].get("casadi") != versions().get("casadi"):
            unknown.append(name)
        elif part["code"] != digest(study.name):
            other.append(name)

    def named(parts: list[str]) -> str:
        return "all parts" if len(parts) == len(record["parts"]) else ", ".join(parts)

    said = []
    if other:
        said.append(f"made with other code: {named(other)} (--again makes it anew)")
    if unknown:
        said.append(f"not known whether made with this code: {named(unknown)}")
    return "; ".join(said)


def _settings(study: Study, part: Part, n_seeds: int) -> list[int]:
    n = part.seeds(n_seeds)
    return [study.seed0, n] if n else []


Progress = Callable[[str, float, float], None]
"""Called with the part in work, the expected seconds done, and their total."""


def run(
    name: str,
    folder: str | Path,
    *,
    n_seeds: int | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run what is pending of a study, write each part when it is done, return the record.

    While another process runs the study in the folder this one waits, and takes over its parts.

    Args:
        name: of the study.
        folder: where ``NAME.json`` is kept.
        n_seeds: fresh seeds; the study's own number by default.
        again: run all parts, kept or not.
        progress: see :data:`Progress`.

    Raises:
        ParameterError: unknown study, fewer than two seeds. DataError : the folder cannot be used.
    """
    study = get(name)
    n = study.seeds if n_seeds is None else n_seeds
    if n < 2:
        raise ParameterError(f"a study of {n} seeds says nothing: 2 at least")
    with locked(Path(folder), f"{name}.lock"):
        return _run(study, folder, n, again=again, progress=progress)


def _run(
    study: Study, folder: str | Path, n: int, *, again: bool, progress: Progress | None
) -> dict[str, Any]:
    name, fixed = study.name, study.fixed()
    todo = list(study.parts) if again else pending(study, folder, n)
    record = read(study, folder)
    if record["fixed"] != fixed:
        record["parts"] = {}
    total = sum(study.parts[p].seconds(n) for p in todo)
    done = 0.0
    for key in todo:
        part = study.parts[key]

        def tell(k: int, of: int, key: str = key, part: Part = part, done: float = done) -> None:
            if progress is not None:
                progress(key, done + part.seconds(n) * min(k / max(of, 1), 1.0), total)

        tell(0, 1)
        began = time.perf_counter()
        result = _plain(part.run(part.seeds(n), study.seed0, tell))
        record["parts"][key] = kept.signed({
            "seeds": _settings(study, part, n),
            "seconds": round(time.perf_counter() - began, 1),
            "versions": versions(),
            "code": digest(study.name),
            "result": result,
        })  # fmt: skip
        ordered = {k: record["parts"][k] for k in study.parts if k in record["parts"]}
        record = {"study": name, "title": study.title, "goal": study.goal, "tuned": study.tuned,
                  "fixed": fixed, "parts": ordered}  # fmt: skip
        write_text(path_of(study, folder), _text(record))
        done += part.seconds(n)
        if progress is not None:
            progress(key, done, total)
    return record


def _text(record: Mapping[str, Any]) -> str:
    """Return a record as JSON, its lists of numbers on one line each."""
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
    return (
        re.sub(
            r"\[\s+([^\[\]{}]*?)\s+\]", lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text
        )
        + "\n"
    )


def expected_seconds(names: Sequence[str], n_seeds: int | None = None) -> float:
    """Return how long studies are expected to take on one core, s."""
    return sum(
        part.seconds(n_seeds or get(n).seeds) for n in names for part in get(n).parts.values()
    )
