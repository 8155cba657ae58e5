"""A host of exported FMUs by their C interface: co-simulation, and model exchange by SciPy."""

import ctypes as c
import math
import zipfile
from pathlib import Path
from tempfile import mkdtemp
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.integrate import solve_ivp

from scenarios.export.fmu import platform_folder


class Fmu:
    """One instance of an FMU, unpacked into a folder; every status but 0 is an error."""

    def __init__(self, path, folder, *, exchange=False, token=None):
        folder = mkdtemp(dir=folder)  # a loaded library must not be written to
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        root = Xml.fromstring((Path(folder) / "modelDescription.xml").read_text())
        self.fmi = int(root.get("fmiVersion")[0])
        name = root.get("modelName")
        self.names = [v.get("name") for v in root.find("ModelVariables")]
        self.at = {v.get("name"): int(v.get("valueReference")) for v in root.find("ModelVariables")}
        self.states = sum(v.get("derivative") is not None for v in root.iter())
        where, end = platform_folder(self.fmi)
        self.library = c.CDLL(str(Path(folder) / "binaries" / where / f"{name}{end}"))
        self.said = []
        own = (token or root.get("instantiationToken") or root.get("guid")).encode()
        self.one = self._new(own, exchange)

    def _new(self, token, exchange):
        if self.fmi == 3:
            kind = c.CFUNCTYPE(None, c.c_void_p, c.c_int, c.c_char_p, c.c_char_p)
            self._log = kind(lambda host, status, category, text: self.said.append(text.decode()))
            new = getattr(
                self.library, f"fmi3Instantiate{'ModelExchange' if exchange else 'CoSimulation'}"
            )
            new.restype, flags = c.c_void_p, [c.c_bool(False)] * (2 if exchange else 4)
            more = [] if exchange else [None, c.c_size_t(0)]
            last = [] if exchange else [None]
            return new(b"one", token, None, *flags, *more, None, self._log, *last)
        kind = c.CFUNCTYPE(
            None, c.c_void_p, c.c_char_p, c.c_int, c.c_char_p, c.c_char_p, c.c_char_p
        )
        self._log = kind(lambda *a: self.said.append(a[5].decode()))
        self._callbacks = (c.c_void_p * 5)(c.cast(self._log, c.c_void_p).value)
        new = self.library.fmi2Instantiate
        new.restype = c.c_void_p
        return new(b"one", 0 if exchange else 1, token, None, self._callbacks, 0, 0)

    def call(self, name, *given):
        """Call a function of the standard; raise with what the FMU said."""
        status = getattr(self.library, f"fmi{self.fmi}{name}")(c.c_void_p(self.one), *given)
        if status:
            raise RuntimeError(self.said[-1] if self.said else f"{name}: status {status}")

    def start(self, values):
        """Initialise with these values."""
        self.put(values)
        f, zero = c.c_bool(False), c.c_double(0.0)
        if self.fmi == 3:
            self.call("EnterInitializationMode", f, zero, zero, f, zero)
        else:
            self.call("SetupExperiment", 0, zero, zero, 0, zero)
            self.call("EnterInitializationMode")
        self.call("ExitInitializationMode")

    def put(self, values):
        """Set variables by name."""
        n = len(values)
        at, numbers = (
            (c.c_uint * n)(*(self.at[k] for k in values)),
            (c.c_double * n)(*values.values()),
        )
        self._access("Set", at, n, numbers)

    def take(self, names):
        """Return values by name, in order."""
        n = len(names)
        numbers = (c.c_double * n)()
        self._access("Get", (c.c_uint * n)(*(self.at[k] for k in names)), n, numbers)
        return list(numbers)

    def _access(self, what, at, n, numbers):
        if self.fmi == 3:
            self.call(f"{what}Float64", at, c.c_size_t(n), numbers, c.c_size_t(n))
        else:
            self.call(f"{what}Real", at, c.c_size_t(n), numbers)

    def step(self, t, h):
        """Go on by a communication step."""
        given = c.c_double(t), c.c_double(h)
        if self.fmi == 3:
            flags, last = (c.c_bool * 3)(), c.c_double()
            by = [c.byref(flags, i) for i in range(3)]
            self.call("DoStep", *given, c.c_bool(True), *by, c.byref(last))
        else:
            self.call("DoStep", *given, 1)

    def update(self):
        """Go through event mode."""
        self.call("EnterEventMode")
        if self.fmi == 3:
            flags, last = (c.c_bool * 5)(), c.c_double()
            self.call("UpdateDiscreteStates", *(c.byref(flags, i) for i in range(5)), c.byref(last))
        else:
            self.call("NewDiscreteStates", (c.c_char * 64)())
        self.call("EnterContinuousTimeMode")

    def vector(self, name, values=None):
        """Get or set all states, or get their rates."""
        n = self.states
        numbers = (c.c_double * n)(*([] if values is None else values))
        self.call(name, numbers, c.c_size_t(n))
        return np.array(numbers)


def cosimulate(path, folder, *, t_end, names, dt=0.02, changes=(), start=None):
    """Return instants and values, shape (names, instants); ``changes`` by instant and name.

    It stops at multiples of ``dt``, and where something changes.
    """
    one = Fmu(path, folder)
    one.start(start or {})
    left, t, rows = list(changes), [0.0], [one.take(names)]
    while t[-1] < t_end - 1e-9:
        while left and left[0][0] <= t[-1] + 1e-9:
            one.put(left.pop(0)[1])
        mark = dt * (math.floor(t[-1] / dt + 1e-6) + 1)
        h = min(mark, t_end, *(at for at, _ in left[:1])) - t[-1]
        one.step(t[-1], h)
        t.append(t[-1] + h)
        rows.append(one.take(names))
    one.call("Terminate")
    assert not one.said
    return np.array(t), np.array(rows).T


def exchanged(path, folder, *, instants, names, changes=(), start=None, **how):
    """The same by model exchange: rates of the FMU, an integrator of SciPy."""
    one = Fmu(path, folder, exchange=True)
    one.start(start or {})
    one.update()
    rates = "GetContinuousStateDerivatives" if one.fmi == 3 else "GetDerivatives"

    def f(t, x):
        one.call("SetTime", c.c_double(t))
        one.vector("SetContinuousStates", x)
        return one.vector(rates)

    left, t, rows = list(changes), 0.0, []
    for end in sorted({*instants, *(at for at, _ in changes)}):
        if end > t:  # to the end of each interval: interpolants of SciPy err more
            done = solve_ivp(f, (t, end), one.vector("GetContinuousStates"), t_eval=[end], **how)
            assert done.success
            f(end, done.y[:, -1])
        t = end
        if any(abs(t - i) < 1e-12 for i in instants):
            rows.append(one.take(names))
        while left and left[0][0] <= t:
            one.put(left.pop(0)[1])
            one.update()
    assert not one.said
    return np.array(rows).T
