"""Cases of the compiled steps, one file for each room; ``tests/test_compiled.py`` runs them."""

from collections.abc import Callable

import pytest

import neuroslam.compiled as switch

CASES: dict[str, Callable] = {}
"""Step -> case: a function that makes random inputs, and returns pairs of arrays: what the
definition gave, and what the step gave."""


def case(*steps):
    """Register a case of steps of the package, named without ``neuroslam.``."""

    def register(make):
        CASES.update({f"neuroslam.{step}": make for step in steps})
        return make

    return register


def with_and_without(do):
    """Do the same by the definition and by compiled steps; pairs of the arrays that it returns."""
    found = []
    for enabled in (False, True):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(switch, "ENABLED", enabled)
            found.append(do())
    return list(zip(*found, strict=True))
