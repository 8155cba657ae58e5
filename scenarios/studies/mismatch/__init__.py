"""The mismatch study: what estimates say of a world that is not as the filters believe.

=============================================== ================================================
:mod:`scenarios.studies.mismatch.imperfections` the imperfections by name, each one small entry
:mod:`scenarios.studies.mismatch.pipeline`      simulate, measure, estimate, and count
=============================================== ================================================
"""
