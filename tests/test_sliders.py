"""Sliders of notebooks: with widgets in a kernel, and complete without."""

import sys
from types import SimpleNamespace

import pytest

from scenarios.figures import sliders as module
from scenarios.figures.sliders import sliders

RANGES = {"mu": (0.01, 0.2, 0.01, 0.05), "k_rf": (0.5, 50.0, 0.5, 20.0)}


def test_without_a_kernel_or_widgets_there_is_one_picture(monkeypatch):
    seen = []
    sliders(lambda **values: seen.append(values), **RANGES)
    assert seen == [{"mu": 0.05, "k_rf": 20.0}]
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    sliders(lambda **values: seen.append(values), **RANGES)
    assert len(seen) == 2


@pytest.mark.parametrize("kernel", [None, object()])
def test_with_a_kernel_sliders_call_it(monkeypatch, kernel):
    calls, seen = [], []
    widgets = SimpleNamespace(
        FloatSlider=lambda **how: SimpleNamespace(**how),
        interact=lambda show, **moved: calls.append({n: s.value for n, s in moved.items()}),
    )
    shell = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=kernel))
    monkeypatch.setitem(sys.modules, "ipywidgets", widgets)
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setattr(module, "find_spec", lambda name: True)
    sliders(lambda **values: seen.append(values), **RANGES)
    first = [{"mu": 0.05, "k_rf": 20.0}]
    assert (calls, seen) == ((first, []) if kernel else ([], first))
