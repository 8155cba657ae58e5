"""The isolation bank as a classifier of scikit-learn: its own checks, and the bank's answers."""

import pickle

import numpy as np
import pytest

from estimators.apu.isolation.classifiers import isolate, recording_of
from estimators.apu.isolation.problem import CLASSES, Protocol
from estimators.apu.isolation.truth import simulate_windows
from estimators.apu.isolation.windowmodel import model_of

base = pytest.importorskip("sklearn.base", reason="extra 'learn'")
sklearnbank = pytest.importorskip("estimators.apu.isolation.sklearnbank")
SHORT = Protocol(before=0.4, after=0.6, spread=0.2)
NAMES = np.array([c.name for c in CLASSES])


@pytest.fixture(scope="module")
def windows():
    return simulate_windows([0, 4, 8], [5, 6, 7], SHORT)


def test_checks_of_scikit_learn_that_apply():
    """Those that do not give windows of a length that is no window, which is told."""
    from sklearn.utils.estimator_checks import check_estimator

    made = check_estimator(sklearnbank.IsolationBank(), on_fail=None, on_skip=None)
    failed = [c for c in made if c["status"] == "failed"]
    for c in failed:
        error, words = c["exception"], ""
        while error is not None:
            words, error = words + str(error), error.__cause__ or error.__context__
        assert "are expected: 7 readings" in words, c["check_name"]
    assert sum(c["status"] == "passed" for c in made) >= 24


@pytest.mark.long
def test_it_answers_as_the_bank(windows):
    X = sklearnbank.rows_of(windows)
    bank = sklearnbank.IsolationBank("glr", SHORT)
    p = base.clone(bank).fit(X[[0, 1, 2]], NAMES[windows.truth]).predict_proba(X)
    whole = bank.fit(np.repeat(X[:1], NAMES.size, axis=0), NAMES)
    full = whole.predict_proba(X)
    order = [NAMES.tolist().index(c) for c in whole.classes_]
    model = model_of(_gas_generator(), SHORT.N_walk)
    for i in range(3):
        said = isolate(recording_of(model, windows, i, SHORT), SHORT, methods=("glr",))
        np.testing.assert_allclose(full[i], np.exp(said.log_probability["glr"][order]), atol=1e-12)
    assert p.shape == (3, 3) and p.sum(axis=1) == pytest.approx(1.0)
    # whoever else is asked, and after a pickle, the same
    np.testing.assert_array_equal(whole.predict_proba(X[1:2]), full[1:2])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(whole)).predict(X), whole.predict(X))
    assert whole.n_features_in_ == X.shape[1] == 7 * SHORT.size + 4


def test_what_is_no_window_or_class(windows):
    X = sklearnbank.rows_of(windows)
    with pytest.raises(ValueError, match="class 'TTCS' \\(did you mean 'TTSC'"):
        sklearnbank.IsolationBank("glr", SHORT).fit(X, ["TTCS", "TTSC", "TTSC"])
    with pytest.raises(ValueError, match="424 feature\\(s\\); 3154 are expected"):
        sklearnbank.IsolationBank().fit(X, NAMES[:3])


def _gas_generator():
    from apu_casadi.gaspath.gasgenerator import GasGenerator

    return GasGenerator()
