"""Discrete gradients of measures against differences of their values."""

import numpy as np
import pytest

from dolfinx_nts.kernels.measures import Along, Angle, Length

KINDS = {Length: 1, Along: 2, Angle: 3}
kinds = pytest.mark.parametrize("kind", KINDS)


def ends(kind, apart, n=5):
    """Vectors at both ends, and the measure there; angles of vectors of any length."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=(n, KINDS[kind], 3))
    b = a + apart * rng.normal(size=a.shape)
    at_a = kind.value(a, np.zeros(n))
    return a, b, at_a, kind.value(b, at_a)


@kinds
@pytest.mark.parametrize("apart", [0.5, 1e-2, 1e-5])
def test_its_product_with_the_motion_is_the_change(kind, apart):
    a, b, at_a, at_b = ends(kind, apart)
    if kind is Angle:  # on the circle, where a revolute joint keeps z
        for p in (a, b):
            p[:, 2] /= np.linalg.norm(p[:, 2], axis=1)[:, None]
            p[:, 0] = np.cross(p[:, 2], [0.0, 0.0, 1.0])
            p[:, 0] += 0.3 * p[:, 2]
            p[:, 0] /= np.linalg.norm(p[:, 0], axis=1)[:, None]
            p[:, 1] = p[:, 2] - p[:, 0] * np.einsum("ni,ni->n", p[:, 0], p[:, 2])[:, None]
            p[:, 1] /= np.linalg.norm(p[:, 1], axis=1)[:, None]
        at_a = kind.value(a, np.zeros(len(a)))
        at_b = kind.value(b, at_a)
    mean = kind.gradient(a, b, at_a, at_b).mean
    change = np.einsum("nz,nz->n", mean, (b - a).reshape(mean.shape))
    assert np.abs(change - (at_b - at_a)).max() < 1e-14


@kinds
@pytest.mark.parametrize("apart", [0.5, 1e-4, 0.0])
def test_its_derivatives(kind, apart):
    a, b, at_a, at_b = ends(kind, apart)
    found, step = kind.gradient(a, b, at_a, at_b), 1e-6
    for z in range(3 * KINDS[kind]):
        way = np.zeros_like(b)
        way.reshape(len(b), -1)[:, z] = step
        values = [kind.value(b + sign * way, at_b) for sign in (1, -1)]
        more, less = (
            kind.gradient(a, b + sign * way, at_a, value).mean
            for sign, value in zip((1, -1), values, strict=True)
        )
        slope = (values[0] - values[1]) / (2 * step)
        assert np.abs(found.end[:, z] - slope).max() < 1e-8 * np.abs(found.end).max()
        bend = (more - less) / (2 * step)
        assert np.abs(found.change[:, :, z] - bend).max() < 1e-8 * np.abs(found.change).max()


@kinds
def test_ends_may_change_places(kind):
    a, b, at_a, at_b = ends(kind, 0.5)
    one, two = kind.gradient(a, b, at_a, at_b).mean, kind.gradient(b, a, at_b, at_a).mean
    assert np.abs(one - two).max() < 1e-14 * np.abs(one).max()
