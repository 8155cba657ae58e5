"""Runs of exported FMUs in FMPy, by its own low-level interface, so that parameters can change."""

import shutil

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave


def cosimulate(path, *, t_end, names, dt=0.02, changes=(), start=None):
    """Run as co-simulation; return instants and values, shape (names, instants).

    ``changes`` are pairs of an instant and values by name, ``start`` values set before it.
    """
    description = read_model_description(path)
    at = {v.name: v.valueReference for v in description.modelVariables}
    folder = extract(path)
    new = FMU3Slave if description.fmiVersion.startswith("3") else FMU2Slave
    told = []
    one = new(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="one",
    )
    give, take = (
        (one.setFloat64, one.getFloat64) if new is FMU3Slave else (one.setReal, one.getReal)
    )

    def put(values):
        give([at[n] for n in values], list(values.values()))

    try:
        one.instantiate()
        put(start or {})
        if new is FMU2Slave:
            one.setupExperiment(startTime=0.0)
            one.enterInitializationMode()
        else:
            one.enterInitializationMode(startTime=0.0)
        one.exitInitializationMode()
        left, t, rows = list(changes), [0.0], [take([at[n] for n in names])]
        while t[-1] < t_end - 1e-9:
            while left and left[0][0] <= t[-1] + 1e-9:
                put(left.pop(0)[1])
            h = min(dt, t_end - t[-1], *(c[0] - t[-1] for c in left[:1]))
            one.doStep(currentCommunicationPoint=t[-1], communicationStepSize=h)
            t.append(t[-1] + h)
            rows.append(take([at[n] for n in names]))
        one.terminate()
        one.freeInstance()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    assert not told
    return np.array(t), np.array(rows).T
