"""Scenes to be turned: pyvista gets what pictures show. Skipped where pyvista is not installed."""

import numpy as np
import pytest
from scenes import box, symmetry

import dolfinx_nts as nts
from dolfinx_nts.output.interactive import view

pytest.importorskip("pyvista")


def test_actors_are_where_bodies_are():
    block = nts.Continuum(
        box(cells=2), nts.NeoHookean(1e5, 0.3), density=1e3, name="block", bcs=symmetry()
    )
    rigid = nts.RigidBody(box((2, 0, 0), (3, 1, 1), 1), density=1.0, name="hard")
    bottom = block.surface(lambda x: np.isclose(x[2], 0.0))
    pair = nts.ContactPair(bottom, nts.Plane((0, 0, 0), (0, 0, 1)))
    spring = nts.Spring(block, rigid, [(1, 0.5, 0.5), (2, 0.5, 0.5)], stiffness=1.0)
    pin = nts.Fixed(None, rigid, point=(2.5, 0.5, 0.5))
    system = nts.System([block, rigid], contacts=[pair], joints=[spring, pin])
    block.u.interpolate(lambda x: np.stack([0.5 * x[0], 0 * x[0], 0 * x[0]]))
    actors = view(system).actors
    assert actors["block"].bounds == pytest.approx((0.0, 1.5, 0.0, 1.0, 0.0, 1.0))
    assert actors["hard"].bounds == pytest.approx((2.0, 3.0, 0.0, 1.0, 0.0, 1.0))
    low, high = np.reshape(actors["obstacles"].bounds, (3, 2)).T
    assert actors["obstacles from behind"].bounds == actors["obstacles"].bounds
    assert low[2] == high[2] == 0.0 and (low[:2] < 0.0).all() and (high[:2] > [3.0, 1.0]).all()
    assert {"lines", "points"} <= set(actors) and "axes" not in actors
    stretched = view([block], colour=nts.von_mises, limits=(0.0, 2e5)).mapper
    assert stretched.scalar_range == (0.0, 2e5)
    stress = np.asarray(stretched.dataset.active_scalars)
    assert stress == pytest.approx(nts.von_mises(block).x.array.max(), rel=1e-9)
