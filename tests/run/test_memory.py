"""What many runs leave behind: nothing."""

import gc
import os
import subprocess
import sys
import textwrap
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx.mesh import CellType, create_box
from petsc4py import PETSc
from processes import in_fresh_python, on_ranks

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD


def scene(comm, modulus=1e6):
    """Two blocks that rub and a rigid body on a joint."""

    def box(low, high):
        return create_box(comm, [np.array(low), np.array(high)], [2, 2, 2], CellType.hexahedron)

    rubber = nts.StVenantKirchhoff(modulus, 0.3)
    left = nts.Continuum(box((0.0, 0, 0), (1.0, 1, 1)), rubber, density=1e3, velocity=(1, 0, 0),
                         name="left")  # fmt: skip
    right = nts.Continuum(box((1.001, -0.1, -0.1), (2, 1.1, 1.1)), rubber, density=1e3,
                          name="right")  # fmt: skip
    arm = nts.RigidBody.from_inertia(1.0, (1, 1, 1), (5, 0, 0), name="arm", comm=comm)
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1.001 + 1e-9), friction=0.2,
    )  # fmt: skip
    return nts.System([left, right, arm], contacts=[pair],
                      joints=[nts.Spherical(arm, None, point=(5, 1, 0))])  # fmt: skip


def one_run(modulus):
    with scene(COMM, modulus) as system:
        run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
    assert run.status == "completed"
    del run, system
    gc.collect()


def resident():
    """Memory of this process [B]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.parametrize("left", ["", "kept = scene(COMM)"])
@pytest.mark.slow
def test_a_destroyed_system_leaves_no_petsc_object(left):
    """PETSc's own list of what was never freed, which names those of a system that is left."""
    code = f"""
        import sys
        sys.path[:0] = {[str(p) for p in Path(__file__).parents[:2]]!r}
        import dolfinx_nts as nts
        from test_memory import COMM, scene
        with scene(COMM) as system:
            run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
        {left}
        print(run.status)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=300,
        check=True, env={**os.environ, "PETSC_OPTIONS": "-objects_dump all"},
    )  # fmt: skip
    assert "completed" in done.stdout
    told = "never freed" in done.stdout + done.stderr
    if left and not told:
        pytest.skip("this PETSc lists nothing")
    assert told == bool(left)


@pytest.mark.mpi
def test_what_is_left_of_a_destroyed_system(tmp_path):
    """Its run can be read, saved and plotted; what would need PETSc says so."""
    with scene(COMM) as system:
        run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
    path = COMM.bcast(tmp_path) / "run.h5"
    run.save(path)
    assert nts.load(path).summary == run.summary
    load = run.contact_fields(system.bodies[0])["contact_load_left-right"].x.array
    assert np.isfinite(load).all()
    for use in (
        lambda: nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3),
        lambda: nts.equilibrium(system),
        lambda: nts.motion_of(system.bodies[0]),
        lambda: nts.System(system.bodies[:1]),
    ):
        with pytest.raises(ValueError, match="^body 'left' was destroyed, by body.destroy"):
            use()
    body, zero = system.bodies[0], np.zeros(system.bodies[0].num_owned)
    for use in (
        lambda: body.internal(zero),
        lambda: body.inertia(zero),
        lambda: body.tangent(zero, 1.0, 0.0),
        lambda: body.nodal_stiffness(),
        lambda: body.smallest_det(zero),
    ):
        with pytest.raises(ValueError, match="^body 'left' was destroyed"):
            use()
    with pytest.raises(ValueError, match="^body 'arm' was destroyed"):
        nts.motion_of(system.bodies[2])


@pytest.mark.mpi
def test_forces_of_a_users_own_in_a_destroyed_body_say_so():
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
    body = nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=1e3, name="box",
        extra_form=lambda u, v, w, t: 3.0 * ufl.inner(v, w) * ufl.dx,
    )  # fmt: skip
    stepper = nts.Stepper(nts.System([body]), nts.Midpoint())
    stepper.advance(1e-3)
    stepper.close()
    body.destroy()
    with pytest.raises(ValueError, match="^body 'box' was destroyed"):
        body.external(np.zeros(body.num_owned), np.zeros(3))


def test_a_stepper_of_a_destroyed_system_says_so():
    stepper = nts.Stepper(scene(COMM), nts.EnergyMomentum())
    stepper.advance(1e-3)
    stepper.system.destroy()
    with pytest.raises(ValueError, match="^body 'left' was destroyed"):
        stepper.advance(1e-3)
    stepper.close()


@pytest.mark.mpi
@pytest.mark.slow
def test_runs_share_the_names_of_their_options():
    """PETSc keeps each prefix that it has seen: new ones took 0.3 kB a run, for ever."""

    class Names:
        def start(self, stepper):
            self.seen = set()

        def write(self, stepper, *, last=False):
            self.seen |= {n for n in PETSc.Options().getAll() if n.startswith("nts_")}

        def close(self, stepper):
            pass

    writers = [Names(), Names()]
    gc.collect()  # what earlier tests have left may use a prefix until it is collected
    for writer in writers:
        with scene(COMM) as system:
            nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3, output=[writer])
        del system
        gc.collect()
    assert writers[0].seen and writers[0].seen == writers[1].seen


@pytest.mark.slow
def test_a_hundred_systems_in_one_process():
    """After the first some, each leaves a thirtieth at most of what its objects take (290 kB)."""
    for k in range(20):
        one_run(1e6 + k)
    before = resident()
    for k in range(100):
        one_run(2e6 + k)
    assert resident() - before < 100 * 10e3


LEFT_OPEN = """
from mpi4py import MPI
import dolfinx_nts as nts
from dolfinx.mesh import CellType, create_box
from dolfinx_nts.solve.accuracy import ACCURACY
rubber = nts.NeoHookean(young=1e6, poisson=0.3)
cubes = [
    nts.Continuum(
        create_box(MPI.COMM_WORLD, [[0, 0, z], [1, 1, z + 1]], [4, 4, 4], CellType.hexahedron),
        rubber, density=1e3, velocity=(0, 0, way), name=name,
    )
    for z, way, name in ((0.0, 1.0, "lower"), (1.01, -1.0, "upper"))
]
faces = [cube.surface(lambda x: abs(x[2] - 1.005) < 0.006) for cube in cubes]
system = nts.System(cubes, contacts=[nts.ContactPair(*faces)])
stepper = nts.Stepper(system, nts.EnergyMomentum(), newton=ACCURACY["balanced"])
for _ in range(20):
    stepper.advance(1e-3)
assert stepper.solution.balance["active"].any()
"""


@pytest.mark.slow
@pytest.mark.parametrize("then", ["", "del stepper"], ids=["kept", "dropped"])
def test_a_stepper_that_nobody_closes_ends_with_python(then):
    """PETSc would free the preconditioners that Python serves after Python has gone."""
    in_fresh_python(LEFT_OPEN + then)


@pytest.mark.slow
def test_a_stepper_that_nobody_closes_ends_with_python_on_ranks():
    on_ranks(2, "-c", LEFT_OPEN)
