"""Equilibrium that goes on from an earlier one, in memory or from a file."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
RUBBER = nts.NeoHookean(young=1e6, poisson=0.3)
#: Of the two runs over the uninterrupted one's largest value.
SAME = 1e-10
OPTIONS = {"newton": nts.Newton(rtol=1e-12)}

pytestmark = pytest.mark.mpi


def scene(friction=0.3, names=("block", "plate"), end=(0.05, 0.0, -0.02)):
    """A block pressed on a plate, 0.002 m inside, and dragged along it by its top."""
    top = nts.Dirichlet(lambda x: x[2] > 1.998 - 1e-9, value=lambda t: t * np.array(end))
    low = nts.Dirichlet(lambda x: x[2] < 1e-9)

    def body(name, low, high, cells, bcs):
        mesh = create_box(COMM, [low, high], cells, CellType.hexahedron)
        return nts.Continuum(mesh, RUBBER, density=1e3, bcs=[bcs], name=name)

    block = body(names[0], (0, 0, 0.998), (1, 1, 1.998), (3, 2, 2), top)
    plate = body(names[1], (-0.5, -0.5, 0), (1.7, 1.5, 1), (4, 3, 2), low)
    pair = nts.ContactPair(
        block.surface(lambda x: x[2] < 0.998 + 1e-9), plate.surface(lambda x: x[2] > 1 - 1e-9),
        friction=friction, interference="resolve",
    )  # fmt: skip
    return nts.System([block, plate], contacts=[pair], gravity=(0, 0, -9.81))


def same(found, wanted, works=None):
    """Compare states, forces and, with those of the first part, works of two equilibria."""
    size = max(COMM.allreduce(np.abs(u).max(initial=0.0), op=MPI.MAX) for u in wanted.state.u)
    for a, b in zip(found.state.u, wanted.state.u, strict=True):
        assert np.abs(a - b).max(initial=0.0) < SAME * size
    force = np.abs(wanted.contact_forces[-1]).max()
    assert np.abs(found.contact_forces[-1] - wanted.contact_forces[-1]).max() < 1e-8 * force
    stored = wanted.balance["energy"][-1]
    for name in ("external_work", "interference_work", "friction_dissipation", "ledger_residual"):
        both = found.balance[name][-1] + (0.0 if works is None else works[name][-1])
        assert abs(both - wanted.balance[name][-1]) < 1e-8 * stored, name


@pytest.fixture(scope="module")
def whole():
    run = nts.equilibrium(scene(), load_steps=6, **OPTIONS)
    assert run.status == "completed" and run.balance["friction_dissipation"][-1] > 0.0
    return run


@pytest.fixture(scope="module")
def part():
    return nts.equilibrium(scene(), load_steps=[1 / 6, 1 / 3], **OPTIONS)


@pytest.mark.fast_on_ranks()
def test_going_on_ends_where_the_whole_does(whole, part):
    run = nts.equilibrium(part.system, load_steps=4, start=part, **OPTIONS)
    assert run.status == "completed"
    assert run.balance["time"] == pytest.approx(np.arange(2, 7) / 6)
    same(run, whole, part.balance)


def test_going_on_from_a_file(whole, part, tmp_path):
    path = COMM.bcast(tmp_path / "part.h5")
    part.save(path)
    loaded = nts.load(path)
    run = nts.equilibrium(scene(), load_steps=4, start=loaded, **OPTIONS)
    same(run, whole, part.balance)
    with pytest.raises(ValueError, match="the file is of another system: .*friction.*make the sys"):
        nts.equilibrium(scene(friction=0.2), start=loaded)


@pytest.mark.fast_on_ranks()
def test_going_on_after_a_stop(whole):
    """A hook that raises stops at a third; going on takes other steps than the whole, and ends."""

    def stop(time, dt):
        if time > 0.3:
            raise RuntimeError("no further")

    stopped = nts.equilibrium(scene(), load_steps=6, before_step=stop, **OPTIONS)
    assert "no further" in stopped.status and stopped.state.time == pytest.approx(1 / 3)
    run = nts.equilibrium(
        stopped.system, load_steps=[0.5, 2 / 3, 5 / 6, 1.0], start=stopped, **OPTIONS
    )
    assert run.status == "completed"
    same(run, whole, stopped.balance)
    # Friction depends on the path: two steps for four are another one, but a near one.
    coarse = nts.equilibrium(stopped.system, load_steps=2, start=stopped, **OPTIONS)
    assert coarse.status == "completed"
    assert np.abs(coarse.contact_forces[-1] / whole.contact_forces[-1] - 1)[0, [0, 2]].max() < 0.05


@pytest.mark.fast_on_ranks()
def test_a_dynamic_run_starts_from_a_file(tmp_path):
    held = scene(end=(0.0, 0.0, -0.02))
    settled = nts.equilibrium(held, **OPTIONS)
    path = COMM.bcast(tmp_path / "settled.h5")
    settled.save(path)
    times = {"dt": 1e-4, "t_end": 1.0 + 3e-4}
    runs = [
        nts.simulate(held, nts.EnergyMomentum(), start=start, **times)
        for start in (settled, nts.load(path))
    ]
    one, two = (run.balance["energy"] for run in runs)
    assert np.array_equal(one, two)


def test_what_cannot_be_gone_on_from_is_refused(whole, part, tmp_path):
    system = part.system
    with pytest.raises(ValueError, match=r"load_steps=\[0.2, 1.0\]: .* times > 0.333333, where"):
        nts.equilibrium(system, load_steps=[0.2, 1.0], start=part)
    with pytest.raises(ValueError, match="load_steps=3: pass increasing pseudo times > 1, where"):
        nts.equilibrium(whole.system, load_steps=3, start=whole)
    with pytest.raises(TypeError, match=r"start of type State: pass the result of equilibrium"):
        nts.equilibrium(system, start=part.state)
    with pytest.raises(ValueError, match=r"start: has bodies .*'plate'\], not \['other'\]"):
        nts.equilibrium(scene(names=("other", "plate")), start=part)
    with pytest.raises(ValueError, match="prescribed values of body 'block' at t=0.333333 .* off"):
        nts.equilibrium(nts.System(scene(end=(0.05, 0.0, -0.03)).bodies), start=part)
    block = nts.System([nts.Continuum(system.bodies[1].mesh, RUBBER, density=1e3, name="free")])
    run = nts.simulate(block, nts.EnergyMomentum(), dt=1e-3, t_end=1e-3)
    with pytest.raises(TypeError, match="start of type Solution: .*displacement="):
        nts.equilibrium(block, start=run)
    path = COMM.bcast(tmp_path / "run.h5")
    run.save(path)
    with pytest.raises(ValueError, match="start: the file holds a run in time.*Checkpoint"):
        nts.equilibrium(block, start=nts.load(path))
