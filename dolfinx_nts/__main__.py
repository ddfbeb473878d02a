"""`python -m dolfinx_nts --check`: what is installed, whether it works, and what makes it slow."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box
from petsc4py import PETSc

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

#: Products of matrices [1e9 operations/s] below which the BLAS is one without kernels of its own
#: for the processor, as the reference BLAS; it reaches 1 to 3, others 10 or more on one core.
_SLOW = 4.0
#: What the package needs, and what parts of it need.
_NEEDED = ("numpy", "scipy", "mpi4py", "petsc4py", "h5py", "matplotlib", "tqdm")
_OPTIONAL = ("gmsh",)


def _installed() -> Iterator[str]:
    yield f"dolfinx_nts {nts.__version__}, Python {platform.python_version()}"
    yield f"DOLFINx {'.'.join(map(str, compat.VERSION))}, " + ", ".join(map(_version, _NEEDED))
    for name in _OPTIONAL:
        yield _version(name)
    yield f"PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}, {MPI.COMM_WORLD.size} ranks"


def _version(name: str) -> str:
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        found = importlib.util.find_spec(name) is not None
        return f"{name} of unknown version" if found else f"{name} is not installed"


def _slow() -> Iterator[str]:
    """What makes runs slow on this machine."""
    if os.environ.get("OMP_NUM_THREADS") != "1":
        yield "set OMP_NUM_THREADS=1: threads of the BLAS and ranks take the same cores"
    n = 400
    a = np.random.default_rng(0).random((n, n))
    times = []
    for _ in range(5):
        start = time.perf_counter()
        a @ a
        times.append(time.perf_counter() - start)
    speed = 2e-9 * n**3 / min(times)
    if speed < _SLOW:
        yield (
            f"the BLAS multiplies matrices at {speed:.1f}e9 operations/s, others at 10e9 or more: "
            "install an optimised one, e.g. libopenblas0-serial"
        )
    if not PETSc.Sys.hasExternalPackage("mumps"):
        yield "PETSc has no MUMPS, which solves the equations of a step: install a PETSc with it"


def _two_steps() -> Iterator[str]:
    """Compile a form, and let two cubes meet."""
    start = time.perf_counter()
    rubber, bodies = nts.NeoHookean(young=1e6, poisson=0.3), []
    for name, x, speed in (("left", 0.0, 2.0), ("right", 1.001, 0.0)):
        corners = [[x, 0, 0], [x + 1, 1, 1]]
        mesh = create_box(MPI.COMM_WORLD, corners, [2, 2, 2], CellType.hexahedron)
        velocity = (speed, 0, 0)
        bodies.append(nts.Continuum(mesh, rubber, density=1e3, velocity=velocity, name=name))
    faces = (b.surface(lambda x, at=at: np.abs(x[0] - at) < 1e-9)
             for b, at in zip(bodies, (1.0, 1.001), strict=True))  # fmt: skip
    system = nts.System(bodies, contacts=[nts.ContactPair(*faces)])
    yield f"forms compiled or found in {compat.cache_folder()}: {time.perf_counter() - start:.1f} s"
    start = time.perf_counter()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3, progress=False)
    if run.status != "completed":
        raise RuntimeError(f"two steps of two cubes in contact: {run.status}")
    yield f"two steps of two cubes in contact: {time.perf_counter() - start:.2f} s, {run.status}"


def main() -> None:
    """Tell on rank 0 what was found, and raise what does not work; all ranks call it."""
    parser = argparse.ArgumentParser(prog="python -m dolfinx_nts", description=__doc__)
    parser.add_argument("--check", action="store_true", required=True, help="check this machine")
    parser.parse_args()
    root = MPI.COMM_WORLD.rank == 0
    for title, lines in (("installed", _installed()), ("works", _two_steps()), ("slow", _slow())):
        for line in lines:
            if root:
                print(f"{title}: {line}", flush=True)


if __name__ == "__main__":
    main()
