"""The whole unit and its trim front."""

import pytest

from apu_casadi import Apu, GasGenerator, Generator, SeriesLoad, trim
from apu_casadi.core.errors import SignalError
from apu_casadi.gaspath.steady.trimming import trim_gas_generator

KW100 = SeriesLoad.from_power(100e3)


def test_one_function_trims_every_model():
    """The same point by three doors: unit, generator at its speed, gas generator at its power."""
    unit = trim(Apu(), load=KW100)
    apu = Apu()
    alone = trim(Generator(), load=KW100, w_r=apu.w_r(apu.N_ref))
    assert alone.y["P_total"] == pytest.approx(unit.generator.y["P_total"], rel=1e-12)
    fixed = {"N": apu.N_ref, "PW": apu.PW(alone.y["P_total"])}
    gas = trim(GasGenerator(), fixed, dT_isa=5.0)
    assert gas["Wf"] == pytest.approx(unit.gas["Wf"], rel=1e-10)
    assert gas["Wf"] == trim_gas_generator(GasGenerator(), fixed, dT_isa=5.0)["Wf"]


def test_trim_says_what_each_model_takes():
    """A load for a gas generator, two outputs for a unit, and something else altogether."""
    with pytest.raises(SignalError, match="two fixed outputs"):
        trim(GasGenerator(), load=KW100)
    with pytest.raises(SignalError, match="load="):
        trim(Apu(), {"N": 3775.0, "PW": 1e5})
    with pytest.raises(SignalError, match="got str"):
        trim("apu", load=KW100)
