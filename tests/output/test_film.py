"""Films of runs: their frames, and that forces are in them."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from scenes import meeting_blocks

import dolfinx_nts as nts
from dolfinx_nts.output import Film

pytest.importorskip("matplotlib")
image = pytest.importorskip("PIL.Image")

COMM = MPI.COMM_WORLD


def film(path, **options):
    """A film of six steps of two blocks that meet."""
    writer = Film(path, width=4.0, **options)
    run = nts.simulate(
        meeting_blocks(), nts.EnergyMomentum(), dt=2e-3, t_end=12e-3, output=[writer]
    )
    assert run.status.startswith("completed")
    COMM.Barrier()  # rank 0 writes
    frames = []
    with image.open(path) as file:
        for k in range(file.n_frames):
            file.seek(k)
            frames.append(np.asarray(file.convert("RGB")).astype(int))
    return run, frames


def reds(frame):
    """Number of dots that are redder than any colour of bodies."""
    return int((frame[..., 0] - frame[..., 1:].max(axis=-1) > 90).sum())


@pytest.mark.mpi
@pytest.mark.slow
def test_frames_of_a_run(mpi_tmp_path):
    """The first state, every second step; of one size, and arrows where there are forces."""
    run, frames = film(mpi_tmp_path / "new" / "run.gif", every=2)
    assert len(frames) == 4
    assert len({frame.shape for frame in frames}) == 1
    assert any((a != b).any() for a, b in zip(frames, frames[1:], strict=False))
    forces = np.abs(run.contact_forces[::2]).max(axis=(1, 2))
    touches = forces > 0.02 * forces.max()  # others are not drawn; 1e-28 N may be left by rounding
    assert touches.any() and not touches.all()
    assert [reds(frame) > 0 for frame in frames] == touches.tolist()
    _, without = film(mpi_tmp_path / "without.gif", every=2, forces=False)
    assert not any(reds(frame) for frame in without)


class Frames(Film):
    """Keeps the last frame in place of painting."""

    def _draw(self):
        self.last = self._frames[-1]


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_arrows_of_degree_2_are_those_of_degree_1(kind):
    """A uniform pressure gives vertices no force, or a sixteenth of that of a face's middle."""
    found = []
    for degree in (1, 2):
        mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [3, 2, 1], getattr(CellType, kind))
        press = nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, value=lambda t: (0, 0, -0.1 * t))
        body = nts.Continuum(
            mesh, nts.StVenantKirchhoff(1e6, 0.0), density=1.0, bcs=[press], degree=degree
        )
        floor = nts.Plane((0, 0, 0), (0, 0, 1))
        pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), floor)
        writer = Frames("p.gif")
        run = nts.equilibrium(nts.System([body], contacts=[pair]), output=[writer])
        assert run.status.startswith("completed")
        if COMM.rank == 0:
            frame = writer.last
            order = np.lexsort(frame.places.round(6).T)
            assert frame.forces.sum(axis=0) == pytest.approx(run.contact_forces[-1, 0], abs=1e-6)
            found.append((frame.places[order], frame.forces[order]))
    if COMM.rank == 0:
        (x, f), (y, g) = found
        size = np.abs(f).max()
        assert x.shape == (12, 3) and x == pytest.approx(y, abs=1e-9)
        assert f == pytest.approx(g, abs=1e-6 * size)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "run.png"}, "path='run.png': pass a file that ends with .gif"),
        ({"every": 0}, "every=0: pass a whole number of steps >= 1"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        Film(**{"path": "run.gif", **options})
