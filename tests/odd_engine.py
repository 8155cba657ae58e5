"""An engine none of whose numbers is at an end of its range, and engines with one number moved."""

import dataclasses

from apu_casadi.gaspath.gasgenerator import GasGenerator


def odd_engine() -> GasGenerator:
    """An engine none of whose numbers is at an end of its range or hidden by a zero."""
    plain = GasGenerator()
    par = plain.parameters.change(
        altitude=500.0, Mach=0.2, war=0.004, eta_burner=0.99, eta_cpr=0.985, bleed_overboard=0.02
    )
    maps = {}
    for name, values in (
        ("compressor_map", {"c_PR": 0.2, "c_N": 0.4}),
        ("turbine_map", {"n_Re": 0.1, "c_N": 0.3, "k_SM": 1.1, "a_SM": 0.05}),
    ):
        choice = getattr(plain, name)
        maps[name] = dataclasses.replace(choice, calibration=choice.calibration.change(**values))
    maps["compressor_map"] = dataclasses.replace(
        maps["compressor_map"], N_map_des=0.99, beta_des=1.95
    )
    return dataclasses.replace(plain, parameters=par, **maps)


def changed(gg: GasGenerator, name: str, value: float) -> GasGenerator:
    """Return the engine with one number replaced, as a user would."""
    group, _, field = name.partition(".")
    if group == "gas_generator":
        return dataclasses.replace(
            gg, parameters=dataclasses.replace(gg.parameters, **{field: value})
        )
    choice = getattr(gg, group)
    if field in ("N_map_des", "beta_des"):
        return dataclasses.replace(gg, **{group: dataclasses.replace(choice, **{field: value})})
    calibration = choice.calibration.change(**{field: value})
    return dataclasses.replace(gg, **{group: dataclasses.replace(choice, calibration=calibration)})
