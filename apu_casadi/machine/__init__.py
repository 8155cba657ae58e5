"""The wound-rotor starter/generator: machine, fault, exciter, loads."""
