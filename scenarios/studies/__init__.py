"""Studies of estimators and schemes: what is claimed, measured over random runs.

A new estimation study is one new file in :mod:`scenarios.studies.estimation`, which makes a
:class:`~scenarios.studies.registration.Study` and registers its parts, claims, text and figures.
Command line, page and tests find it there.

============================ ==============================================================
estimation                   the studies, one file each
registration                 what a study has, and its decorators
catalogue                    all studies by name; running, and what a kept result is worth
fingerprint, kept            constants and equations; what is kept, checked when it is read
electrical, gaspath          true runs, scores and Monte Carlo that several studies use
jointrun                     a scenario estimated, and what that says
multirate_study, trim_study  studies with commands of their own
============================ ==============================================================
"""
