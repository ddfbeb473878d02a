"""Names of contacts in messages, tables and fields."""

import numpy as np
import pytest
from scenes import at, box

import dolfinx_nts as nts
from dolfinx_nts.ledger.contact_fields import labels
from dolfinx_nts.output import ForcesCSV


@pytest.mark.mpi
def test_a_name_that_is_given_is_used_everywhere(mpi_tmp_path):
    """The others are called by their bodies, and numbered in fields where that is one name."""
    body = nts.RigidBody(box(), density=1.0, name="seal")
    faces = [body.surface(at(2, 0.0)), body.surface(at(0, 0.0)), body.surface(at(1, 0.0))]
    walls = [nts.Plane((0, 0, 0), np.roll((1, 0, 0), k), name="wall") for k in (2, 0, 1)]
    pairs = [
        nts.ContactPair(face, wall, name=name)
        for face, wall, name in zip(faces, walls, ("lid", None, None), strict=True)
    ]
    system = nts.System([body], contacts=pairs)
    assert [pair.name for pair in pairs] == ["lid", "seal-wall", "seal-wall"]
    assert labels(system) == ["lid", "seal-wall_1", "seal-wall_2"]
    assert "'lid'" in repr(pairs[0])
    # A name that is that of a numbered one.
    taken = [nts.ContactPair(faces[0], walls[0], name="seal-wall_2"), *pairs[1:]]
    assert len(set(labels(nts.System([body], contacts=taken)))) == 3
    path = mpi_tmp_path / "forces.csv"
    nts.simulate(
        system, nts.EnergyMomentum(), dt=1e-3, t_end=1e-3, output=[ForcesCSV(path)], progress=False
    )
    if system.comm.rank == 0:
        assert "contact_lid_x [N]" in path.read_text()
    block = nts.Continuum(box(), nts.NeoHookean(young=1e6, poisson=0.3), density=1.0)
    assert nts.SelfContact(block.surface(at(2, 0.0)), name="fold").name == "fold"
    for name, error in (("", ValueError), (3, TypeError)):
        with pytest.raises(error, match="name="):
            nts.ContactPair(faces[0], walls[0], name=name)
