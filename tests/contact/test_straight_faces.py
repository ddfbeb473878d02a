"""Straight faces of degree 2 on a curved part are told, those of a box and of curved cells not."""

import numpy as np
import pytest
from dolfinx.mesh import CellType
from scenes import RUBBER, box

import dolfinx_nts as nts
from dolfinx_nts.contact.straight_faces import turn_of_straight_faces


def ring(cells):
    """A quarter of a ring of straight tetrahedra, so many along it, and its outer surface."""
    mesh = box((1.0, 0.0, 0.0), (1.2, 1.0, 0.2), (1, cells, 1), CellType.tetrahedron)
    radius, angle = mesh.geometry.x[:, 0].copy(), 0.5 * np.pi * mesh.geometry.x[:, 1]
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    body = nts.Continuum(mesh, RUBBER, density=1e3, degree=2, name="ring")
    return body.surface(lambda x: np.hypot(x[0], x[1]) > 1.2 * np.cos(np.pi / cells / 4) - 1e-9)


@pytest.mark.parametrize(("cells", "turn"), [(3, 30.0), (6, 15.0), (10, 0.0)])
def test_a_ring_turns_by_the_angle_of_its_cells(cells, turn):
    """By 90 degrees over their number; at 9 degrees forces change by less than 1 %."""
    assert np.degrees(turn_of_straight_faces(ring(cells))) == pytest.approx(turn, abs=1e-6)


def test_a_run_tells_of_the_ring_and_not_of_a_box():
    block = nts.Continuum(
        box((3, 0, 0), (4, 1, 1), 1, CellType.tetrahedron),
        RUBBER, density=1e3, degree=2, name="box",
    )  # fmt: skip
    every = block.surface(lambda x: np.ones_like(x[0], dtype=bool))
    wall = nts.Plane((5, 0, 0), (-1, 0, 0))
    pairs = [nts.ContactPair(surface, wall) for surface in (ring(6), every)]
    system = nts.System([pair.slave.body for pair in pairs], contacts=pairs)
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    (found,) = stepper.solution.warnings.every
    stepper.close()
    assert found.kind == "straight faces" and found.about == ("ring",) and not found.grave
    assert "turn by 15 degrees" in found.text and "setOrder(2)" in found.text
