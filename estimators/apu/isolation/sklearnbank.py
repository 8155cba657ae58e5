"""The isolation bank as a classifier of scikit-learn: ``pip install 'apu-casadi[learn]'``.

A row of ``X`` is one window: the readings N, P3, T3, T5, h, Wf, PW one after another, each at all
samples of the protocol, then altitude, Mach, dT_isa and war; :func:`rows_of` makes them.  Nothing
is learnt but which classes there are: the bank is a model.

>>> from sklearn.pipeline import make_pipeline  # doctest: +SKIP
>>> IsolationBank().fit(X, names).predict(X_new)  # doctest: +SKIP
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from apu_casadi.core.errors import nearest
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.isolation.classifiers import isolate, recording_of
from estimators.apu.isolation.problem import CLASSES, DEFAULT, OUTPUTS, Protocol
from estimators.apu.isolation.truth import Windows
from estimators.apu.isolation.windowmodel import model_of
from estimators.information.posterior import posterior

try:
    from sklearn.base import BaseEstimator, ClassifierMixin
    from sklearn.utils.multiclass import check_classification_targets
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as e:
    raise ImportError(f"this classifier needs: pip install 'apu-casadi[learn]' ({e})") from e

__all__ = ["IsolationBank", "rows_of"]

NAMES: tuple[str, ...] = tuple(c.name for c in CLASSES)
_CHANNELS = len(OUTPUTS) + 2


def rows_of(w: Windows) -> np.ndarray:
    """Return windows as rows of features, (windows, features)."""
    n = w.reading.shape[1]
    return np.hstack([w.reading.transpose(1, 0, 2).reshape(n, -1), w.ambient.T])


class IsolationBank(ClassifierMixin, BaseEstimator):
    """Fault isolation by a bank of filters, or by the innovations of one.

    Args:
        method: ``"bank"`` or ``"glr"``, see :mod:`estimators.apu.isolation.classifiers`.
        protocol: layout of a window, and priors; the default one if None.
        gas_generator: the engine as the filters know it; the default one if None.
    """

    method: str
    protocol: Protocol | None
    gas_generator: GasGenerator | None
    classes_: np.ndarray

    def __init__(
        self,
        method: str = "bank",
        protocol: Protocol | None = None,
        gas_generator: GasGenerator | None = None,
    ) -> None:
        self.method, self.protocol, self.gas_generator = method, protocol, gas_generator

    def fit(self, X: Any, y: Any) -> Self:
        """Take the classes that there are; equally likely, as the bank's priors are.

        Raises:
            ValueError: rows of another length than the protocol's, or a class that the bank does
                not know.
        """
        X, y = validate_data(self, X, y, ensure_all_finite="allow-nan")
        check_classification_targets(y)
        self._of_protocol(X)
        self.classes_ = np.unique(y)
        for name in self.classes_.tolist():
            if name not in NAMES:
                raise ValueError(f"class {name!r} {nearest(str(name), NAMES)}")
        return self

    def predict_proba(self, X: Any) -> np.ndarray:
        """Return the probability of each class of ``classes_``, (windows, classes)."""
        check_is_fitted(self)
        X = validate_data(self, X, reset=False, ensure_all_finite="allow-nan")
        pr = DEFAULT if self.protocol is None else self.protocol
        gg = GasGenerator() if self.gas_generator is None else self.gas_generator
        model, n = model_of(gg, pr.N_walk), X.shape[0]
        reading = X[:, : -len(AMBIENT)].reshape(n, _CHANNELS, pr.size).transpose(1, 0, 2)
        zeros = np.zeros(n, dtype=int)
        w = Windows(zeros, [{}] * n, zeros, reading, X[:, -len(AMBIENT) :].T)
        at = [NAMES.index(c) for c in self.classes_.tolist()]
        out = np.empty((n, len(at)))
        for i in range(n):
            data = recording_of(model, w, i, pr)
            verdict = isolate(data, pr, gg, methods=tuple(dict.fromkeys(("glr", self.method))))
            out[i] = posterior(verdict.log_probability[self.method][at])
        return out

    def predict(self, X: Any) -> np.ndarray:
        """Return the most probable class of each window."""
        p = self.predict_proba(X)
        return np.asarray(self.classes_[p.argmax(axis=1)])

    def _of_protocol(self, X: np.ndarray) -> None:
        size = (DEFAULT if self.protocol is None else self.protocol).size
        wanted = _CHANNELS * size + len(AMBIENT)
        if X.shape[1] != wanted:
            raise ValueError(
                f"{X.shape[0]} sample(s) of {X.shape[1]} feature(s); {wanted} are expected: "
                f"{_CHANNELS} readings at {size} samples, then {', '.join(AMBIENT)}"
            )

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags
