"""What tells of cells that are too stiff, against the table of another program (theory 19.7)."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from rotations import rotation
from scenes import box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD


def bar(cells, poisson, *, height=1.0, kind=CellType.hexahedron, **options):
    """A bar of length 10 and width 1 that a small load bends, and its equilibrium."""
    ends = ((0.0, 0.0, 0.0), (10.0, 1.0, height))
    mesh = box(*ends, cells, kind)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1.0, poisson=poisson), density=1.0,
        bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9)],
        traction=[nts.Traction(lambda x: x[0] > 10 - 1e-9, (0.0, 0.0, 1e-6 * height**2))],
        **options,
    )  # fmt: skip
    return body, nts.equilibrium(nts.System([body]))


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "poisson", "options", "share"),
    [
        ((20, 2, 2), 0.3, {}, 0.106), ((40, 4, 4), 0.3, {}, 0.032), ((20, 2, 2), 0.4999, {}, 0.97),
        ((20, 2, 2), 0.4999, {"volume": "projected"}, 0.23),
        ((80, 2, 2), 0.3, {"height": 0.1}, 0.29),
    ],
)  # fmt: skip
def test_jumps_of_the_stress(cells, poisson, options, share):
    body, run = bar(cells, poisson, **options)
    jumps, whole = body.locking.stress_jumps()
    assert jumps / whole == pytest.approx(share, rel=0.05)
    assert ("locking" in run.warnings) == (share > 0.1)


@pytest.mark.mpi
def test_one_layer_of_cells_is_told():
    _, run = bar((20, 1, 1), 0.3)
    assert "locking" not in run.warnings
    assert "no node inside" in run.warnings["one cell thick"].text


def test_tetrahedra_are_told_of():
    body, run = bar((20, 2, 2), 0.3, kind=CellType.tetrahedron, degree=1)
    assert "degree=2" in run.warnings["locking"].text and body.name in run.warnings["locking"].about
    _, by_default = bar((20, 2, 2), 0.3, kind=CellType.tetrahedron)
    assert "locking" not in by_default.warnings


@pytest.mark.slow
def test_a_wave_is_no_locking():
    """Stress jumps at the front of a wave in the first steps, and little once it has spread."""
    ends = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    mesh = create_box(COMM, ends, (8, 8, 8), CellType.hexahedron)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, velocity=(1.0, 0.0, 0.0),
        name="cube",
    )  # fmt: skip
    wall = nts.Plane(point=(1.004, 0.0, 0.0), normal=(-1.0, 0.0, 0.0))
    contact = nts.ContactPair(body.surface(lambda x: x[0] > 1 - 1e-9), wall)
    s = nts.Stepper(nts.System([body], contacts=[contact]), nts.EnergyMomentum())
    shares = []
    for _ in range(80):
        s.advance(5e-4)
        jumps, whole = body.locking.stress_jumps()
        shares.append(jumps / whole if whole else 0.0)
    s.look(last=True)
    steps, sums = s._locking.memory
    assert steps == 80 and sums[1] > 0.0  # looked at after 64
    assert max(shares) > 0.15 and not set(s.solution.warnings) & {"locking", "one cell thick"}
    s.close()


@pytest.mark.slow
def test_what_a_run_says_is_of_all_its_steps(tmp_path):
    """It goes on from one that ended in the midst of waves, and says what an unbroken run does."""
    mesh = create_box(COMM, ((0.0, 0.0, 0.0), (8.0, 1.0, 1.0)), (16, 2, 2), CellType.hexahedron)

    def system():
        body = nts.Continuum(
            mesh, nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, name="bar",
            velocity=lambda x: np.stack([0 * x[0], 0 * x[0], 0.1 * (x[0] < 0.6)]),
        )  # fmt: skip
        return nts.System([body])

    path, rule = COMM.bcast(tmp_path) / "run.h5", nts.EnergyMomentum()
    written = nts.Checkpoint(path, every=64)
    first = nts.simulate(system(), rule, dt=1e-3, t_end=0.064, checkpoint=written)
    whole = nts.simulate(system(), rule, dt=1e-3, t_end=0.3)
    again = system()
    second = nts.simulate(again, rule, dt=1e-3, t_end=0.3, start=nts.restart(path, again))
    told = [run.warnings["locking"] for run in (first, whole, second)]
    assert [one.count for one in told] == [1, 1, 1]
    assert told[2].worst == pytest.approx(told[1].worst, rel=1e-9)
    assert told[0].worst != pytest.approx(told[1].worst, rel=1e-3)


def test_degree_2_is_sound():
    _, run = bar((20, 2, 2), 0.3, degree=2)
    assert not set(run.warnings) & {"locking", "one cell thick"}


def test_a_bush_that_cannot_change_its_volume_is_told_of():
    """Held at both faces its stress hardly jumps, while it is 100 times too stiff."""
    body, run = held_block(0.4999)
    jumps, whole = body.locking.stress_jumps()
    assert jumps / whole < 0.5 and "hardly changes its volume" in run.warnings["locking"].text
    _, run = held_block(0.4999, volume="projected")
    assert "hardly changes" not in str(run.warnings.get("locking"))


def held_block(poisson, **options):
    """A flat block, one face held and the other one moved aside and down."""
    mesh = create_box(COMM, ((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), (4, 4, 2), CellType.hexahedron)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1e6, poisson=poisson), density=1e3,
        bcs=[
            nts.Dirichlet(lambda x: x[2] < 1e-9),
            nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, value=lambda t: (0.01 * t, 0.0, -0.01 * t)),
        ],
        **options,
    )  # fmt: skip
    return body, nts.equilibrium(nts.System([body]))


@pytest.mark.parametrize(
    ("angle", "sides", "cells", "thin"),
    [
        (0.7, (10, 1, 1), (20, 1, 1), True), (0.0, (4, 4, 1), (4, 4, 1), True),
        (0.7, (4, 4, 1), (4, 4, 1), True), (0.7, (3, 3, 1), (9, 9, 1), False),
        (0.0, (10, 1, 1), (20, 2, 2), False),
    ],
)  # fmt: skip
def test_thin_whatever_way_it_is_turned(angle, sides, cells, thin):
    """Also a square plate, whose long axes may be any two in its plane."""
    mesh = create_box(COMM, (np.zeros(3), np.array(sides, float)), cells, CellType.hexahedron)
    mesh.geometry.x[:] = mesh.geometry.x @ rotation(angle, (1.0, 2.0, 3.0)).T
    body = nts.Continuum(mesh, nts.NeoHookean(young=1.0, poisson=0.3), density=1.0)
    assert body.locking.is_thin == thin


@pytest.mark.mpi
@pytest.mark.parametrize("volume", ["full", "projected"])
def test_a_rank_without_a_cell(volume):
    """One cell: on 2 ranks one of them has none."""
    mesh = create_box(COMM, ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), (1, 1, 1), CellType.hexahedron)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, volume=volume,
        velocity=lambda x: np.array([x[1], 0.0 * x[0], 0.0 * x[0]]),
    )  # fmt: skip
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=0.02)
    assert run.status == "completed"
    energy = run.balance["energy"]
    assert np.abs(energy - energy[0]).max() < 1e-12 * energy[0]
