"""Films of runs: their frames, and that forces are in them."""

from mpi4py import MPI

import numpy as np
import pytest
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
