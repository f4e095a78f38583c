"""Heights of the map: relaxation of rises."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from neuroslam.mapping.heights import Rises, contract_rises, relax_heights


def ring(n, drift_m):
    """Rises round a ring whose measured ones do not add up to 0."""
    source = np.arange(n)
    return Rises(source, (source + 1) % n, np.sin(source) - np.sin(source + 1) + drift_m)


@given(n=st.integers(3, 12), drift_m=st.floats(-0.5, 0.5))
def test_the_error_of_a_loop_is_shared_by_its_rises(n, drift_m):
    rises = ring(n, drift_m)
    rises = rises._replace(rise_m=np.append(rises.rise_m[:-1], -rises.rise_m[:-1].sum() + drift_m))
    z = np.cumsum(np.append(0.0, rises.rise_m[:-1]))
    relax_heights(z, rises, loops=4000, correction=0.5, tolerance=0.0)
    residual = z[rises.target] - z[rises.source] - rises.rise_m
    np.testing.assert_allclose(residual.sum(), -drift_m, atol=1e-9)
    assert np.abs(residual).max() <= abs(drift_m) + 1e-9


def test_rises_that_agree_are_left_alone():
    z = np.array([0.0, 1.0, 3.0])
    rises = Rises(np.array([0, 1]), np.array([1, 2]), np.array([1.0, 2.0]))
    assert relax_heights(z, rises, 5, 0.5) == 0.0
    assert z.tolist() == [0.0, 1.0, 3.0]


def test_contraction_keeps_the_residuals():
    draw = np.random.default_rng(0)
    z, rises = draw.normal(size=6), ring(6, 0.0)
    root = np.array([0, 0, 3, 3, 4, 4])
    kept = contract_rises(rises, z, root)
    before = z[rises.target] - z[rises.source] - rises.rise_m
    after = z[kept.target] - z[kept.source] - kept.rise_m
    np.testing.assert_allclose(after, before[[1, 3, 5]], atol=1e-12)
