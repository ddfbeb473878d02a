"""Equilibria that are not stable are told, and only these."""

import numpy as np
import pytest
from rotations import rotation
from scenes import at, box, everywhere

import dolfinx_nts as nts

YOUNG, SIDE = 1e6, 0.1
#: Buckling load of a slender column of height 1 m, clamped below (Euler) [N]: pi^2 E I / (2 L)^2.
EULER = np.pi**2 * YOUNG * SIDE**4 / 12 / 4


def column(load, width=SIDE):
    """Column of height 1 m under a dead load [N]."""
    foot = nts.Dirichlet(at(2, 0.0))
    push = nts.Traction(at(2, 1.0), (0, 0, -load / (SIDE * width)))
    body = nts.Continuum(
        box([0, 0, 0], [SIDE, width, 1], (2, 2, 20)), nts.NeoHookean(young=YOUNG, poisson=0.0),
        density=1e3, bcs=[foot], traction=[push], name="column",
    )  # fmt: skip
    return nts.equilibrium(nts.System([body]), load_steps=4)


def told(run):
    """Number of motions that release energy, as the run tells it."""
    assert run.status == "completed"
    return run.warnings["unstable equilibrium"].worst if len(run.warnings) else 0


@pytest.mark.mpi
@pytest.mark.parametrize("part, width, expected", [
    (0.9, SIDE, 0),
    (1.5, SIDE, 2),  # in both directions
    (0.9 * 1.5, 1.5 * SIDE, 0),
    (1.5 * 1.5, 1.5 * SIDE, 1),  # Euler's load is 1.5 times this one's, across 1.5^3 times
])  # fmt: skip
def test_a_column_buckles(part, width, expected):
    """Two hexahedra across are too stiff in bending, by a quarter and what they lock."""
    assert told(column(part * EULER, width)) == expected


@pytest.mark.mpi
@pytest.mark.parametrize("up", [True, False])
def test_a_pendulum_stands_or_hangs(up):
    ends = [0, 1] if up else [-1, 0]
    low, high = ([c, c, z] for c, z in zip((-0.05, 0.05), ends, strict=True))
    arm = nts.RigidBody(box(low, high, (1, 1, 4)), density=1e3, name="arm")
    hinge = nts.Revolute(arm, None, point=(0, 0, 0), axis=(0, 1, 0))
    run = nts.equilibrium(nts.System([arm], joints=[hinge], gravity=(0, 0, -9.81)))
    assert told(run) == int(up)


@pytest.mark.mpi
@pytest.mark.parametrize("other", ["steel", "boulder"])
def test_a_pendulum_beside_what_is_stiff_or_heavy(other):
    """What stands elsewhere in the scene does not hide that it falls."""
    arm = nts.RigidBody(
        box([-0.05, -0.05, 0], [0.05, 0.05, 1], 1), density=1e3, name="arm"
    )
    hinge = nts.Revolute(arm, None, point=(0, 0, 0), axis=(0, 1, 0))
    if other == "steel":
        steel = nts.NeoHookean(young=2e11, poisson=0.3)
        foot, mesh = nts.Dirichlet(at(2, 0.0)), box([2, 0, 0], [3, 1, 1], 1)
        body = nts.Continuum(mesh, steel, density=7.8e3, bcs=[foot], name=other)
    else:
        mesh = box([2, 0, 0], [4, 2, 2], 1)
        body = nts.RigidBody(mesh, density=3e3, motion=(0, 0, 0), rotation=(0, 0, 0), name=other)
    run = nts.equilibrium(nts.System([arm, body], joints=[hinge], gravity=(0, 0, -9.81)))
    assert told(run) == 1


@pytest.mark.mpi
@pytest.mark.parametrize("metre", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("far", [0.0, 3.0])
@pytest.mark.parametrize("joint", [nts.Prismatic, nts.Cylindrical, nts.Planar])
def test_a_slider_may_stand_anywhere(joint, far, metre):
    """Its weight acts beside the point of the joint; along the axis nothing resists or drives."""
    options = dict(axis=(0, 0, 1)) if joint is nts.Planar else dict(axis=(1, 0, 0))
    # A cylindrical joint lets it turn, to hang below the axis.
    low, high = [far, -0.1, -0.2 - far], [far + 0.2, 0.1, -far]
    mesh = box(*(metre * np.array(end) for end in (low, high)), 1)
    slider = nts.RigidBody(mesh, density=1e3 / metre**3, name="slider")
    held = joint(slider, None, point=(0, 0, 0), **options)
    run = nts.equilibrium(
        nts.System([slider], joints=[held], gravity=(0, 0, -9.81 * metre))
    )
    assert "unstable equilibrium" not in run.warnings


@pytest.mark.mpi
@pytest.mark.parametrize("rigid", [True, False])
def test_a_block_that_stands_is_stable(rigid):
    """Contact and friction hold it, though nothing of its own does."""
    mesh, options = box([0, 0, 0], [0.2, 0.2, 0.4], (2, 2, 4)), dict(density=1e3, name="block")
    if rigid:
        block = nts.RigidBody(mesh, **options)
    else:
        block = nts.Continuum(mesh, nts.NeoHookean(young=1e5, poisson=0.3), **options)
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    pair = nts.ContactPair(block.surface(at(2, 0.0)), floor, friction=0.5)
    run = nts.equilibrium(nts.System([block], contacts=[pair], gravity=(0, 0, -9.81)))
    assert told(run) == 0


def test_a_block_on_its_edge_is_not():
    """Held by contact at two nodes, straight under its centre: it may tip to either side."""
    mesh = box([0, 0, 0], [0.2, 0.2, 0.2], 1)
    mesh.geometry.x[:] = mesh.geometry.x @ rotation(np.pi / 4, (0, 1, 0))
    block = nts.RigidBody(mesh, density=1e3, name="block")
    floor = nts.Plane((0, 0, mesh.geometry.x[:, 2].min()), (0, 0, 1))
    pair = nts.ContactPair(block.surface(everywhere), floor, friction=0.5)
    run = nts.equilibrium(nts.System([block], contacts=[pair], gravity=(0, 0, -9.81)))
    assert told(run) == 1
