"""Functions as C99: no warning, math.h alone, every digit as Python's; names that are wrong."""

import json
import re

import numpy as np
import pytest

from apu_casadi import Apu, SeriesLoad, Ttsc
from apu_casadi.core.backend import find_compiler
from apu_casadi.core.errors import BackendError, ParameterError, SignalError
from apu_casadi.unit.events import Ambient
from scenarios import cli
from scenarios.export import ccode
from scenarios.export.cfunctions import FUNCTIONS, Asked, exported

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
FAST = ("gas_generator.residual", "generator.f", "generator.g", "generator.z", "generator.residual")
CI = [pytest.param(n, marks=pytest.mark.ci) if n not in FAST else n for n in FUNCTIONS]


@pytest.fixture(scope="module")
def asked():
    load = SeriesLoad.from_power(100e3, 0.9, unbalance=(1.0, 1.1, 0.9))
    return Asked(Apu(), load, Ttsc(0.05, 20.0, 1.0, "b"), Ambient(altitude=3000.0))


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("name", CI)
def test_a_thousand_steps_equal_python_s(asked, name, tmp_path):
    e = exported(name, asked)
    paths = ccode.write(e, tmp_path)
    assert ccode.check(e, tmp_path) == 1000
    rows = [line.split() for line in paths[-1].read_text().splitlines()]
    values = np.array(rows, float)
    assert values.shape == (1000, sum(v.size for v in e.outputs if v.name in e.printed))
    assert np.isfinite(values).all() and np.ptp(values, axis=0).max() > 0
    code = paths[0].read_text()
    assert set(re.findall(r"#include\s+(\S+)", code)) == {"<math.h>", f'"{e.name}.h"'}


def test_header_names_every_entry_with_its_unit(asked):
    e = exported("generator.f", asked)
    text = ccode.header(e)
    for v in (*e.inputs, *e.outputs):
        assert f"generator_f_{v.name}_size = {v.size}" in text
        for i, s in enumerate(v.signals):
            name = s.name.replace(".", "_")
            assert f"generator_f_{v.name}_{name} = {i}, /* {s.unit}: {s.doc} */" in text
    numbers = next(v for v in e.inputs if v.constant)
    at = numbers.signals.index("machine.r_s")
    assert numbers.start[at] == asked.unit.generator.machine.r_s
    assert f"extern const double generator_f_numbers[{numbers.size}]" in text


@pytest.mark.parametrize("name", ["gas_generator.residual", "ekf"])
def test_numbers_of_another_unit_are_another_array_and_the_same_code(asked, name):
    other = Asked(Apu().change({"gas_generator.J": 0.07}), asked.load, asked.fault, asked.ambient)
    one, two = (exported(name, a) for a in (asked, other))
    assert ccode.generated(one.name, [one.function]) == ccode.generated(one.name, [two.function])
    a, b = (next(v for v in e.inputs if v.constant) for e in (one, two))
    assert [s.name for s, p, q in zip(a.signals, a.start, b.start, strict=True) if p != q] == [
        "gas_generator.J"
    ]


def test_what_differs_is_told(asked, tmp_path):
    if find_compiler() is None:
        pytest.skip("no C compiler")
    e = exported("generator.z", asked)
    ccode.write(e, tmp_path)
    expected = tmp_path / "generator_z_expected.txt"
    lines = expected.read_text().splitlines()
    expected.write_text("\n".join([*lines[:6], "1.0", *lines[7:]]))
    with pytest.raises(BackendError, match="generator_z: step 7 of 1000 differs"):
        ccode.check(e, tmp_path)


def test_without_a_compiler_the_check_is_refused(asked, tmp_path, monkeypatch):
    monkeypatch.setattr(ccode, "find_compiler", lambda: None)
    with pytest.raises(BackendError, match="no C compiler found to check it with"):
        ccode.check(exported("generator.z", asked), tmp_path)


def test_wrong_names(asked):
    with pytest.raises(ParameterError, match=r"no function 'stap' to export \(did you mean 'step'"):
        exported("stap", asked)
    with pytest.raises(ParameterError, match=r"generator\.g"):
        exported("generator.gg", asked)
    e = exported("generator.z", asked)
    with pytest.raises(SignalError, match="generator_z: sizes"):
        ccode.Exported(e.name, e.doc, e.function, e.inputs[:-1], e.outputs)


def test_command(tmp_path, capsys):
    out = str(tmp_path / "c")
    fault = "mu = 0.05, k_rf = 20, phase = 'c'"
    argv = ["export", "c", "generator.g", "f", "--load", "90e3", "--fault", fault, "--out", out]
    assert cli.main([*argv, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["generator_g", "gas_generator_f"]
    assert "fault: coupled" in (tmp_path / "c" / "generator_g.h").read_text()
    assert cli.main(["export", "c", "fg", "--out", out]) == 2
    assert "no function 'fg' to export" in capsys.readouterr().err
