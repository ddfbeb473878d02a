"""Blocks whose faces end at the same rims: whole boundaries touch as the faces alone do."""

import numpy as np
import pytest
from scenes import box, everywhere

import dolfinx_nts as nts


def pressed(cells, poisson, where, friction=0.0):
    """Two cubes on each other, the upper one pressed by a fifth of its height; its force [N]."""
    bodies = []
    for z, n, nu, name in zip((1, 0), cells, poisson, ("upper", "lower"), strict=True):
        end, push = (2.0, -0.2) if z else (0.0, 0.0)
        held = nts.Dirichlet(
            lambda x, end=end: np.abs(x[2] - end) < 1e-9,
            value=lambda t, push=push: (0, 0, push * t),
        )
        mesh = box((0, 0, z), (1, 1, z + 1), (n, n, 2))
        rubber = nts.NeoHookean(young=1e6, poisson=nu)
        bodies.append(nts.Continuum(mesh, rubber, density=1e3, bcs=[held], name=name))
    pair = nts.ContactPair(*(body.surface(where) for body in bodies), friction=friction)
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]), load_steps=4)
    assert run.status == "completed" and not run.warnings
    return run.contact_forces[-1, 0]


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "poisson", "friction"),
    [((1, 1), (0.3, 0.3), 0.0), ((4, 3), (0.3, 0.2), 0.0), ((2, 2), (0.3, 0.45), 0.0),
     ((3, 4), (0.3, 0.45), 0.3)],
)  # fmt: skip
def test_nodes_at_the_rims_stay_with_the_face_that_they_face(cells, poisson, friction):
    """A side that no facet of the slave faces is none of its masters, whichever way rims move."""
    whole = pressed(cells, poisson, everywhere, friction)
    faces = pressed(cells, poisson, lambda x: np.abs(x[2] - 1) < 1e-9, friction)
    assert faces[2] > 1e5
    assert whole == pytest.approx(faces, abs=1e-9 * faces[2])
