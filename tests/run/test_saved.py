"""Saved runs: what a file says without the scene is what the run said."""

import json

from mpi4py import MPI

import h5py
import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts
from dolfinx_nts.ledger.balance import Switch

COMM = MPI.COMM_WORLD
NAME = "run.h5"
END = 2e-3


@pytest.fixture(scope="module")
def run():
    """Two blocks that rub, a rigid body on a hinge with a torsion spring."""
    rubber = nts.StVenantKirchhoff(1e6, 0.3)

    def box(low, high, n):
        return create_box(COMM, [np.array(low), np.array(high)], [n] * 3, CellType.hexahedron)

    left = nts.Continuum(box((0.0, 0, 0), (1, 1, 1), 1), rubber, density=1e3, name="left",
                         velocity=(3, 1, 0))  # fmt: skip
    held = nts.Dirichlet(lambda x: x[0] > 2 - 1e-9, value=(0, 0, 0))
    right = nts.Continuum(box((1.004, -0.1, -0.1), (2, 1.1, 1.1), 2), rubber, density=1e3,
                          name="right", bcs=[held])  # fmt: skip
    arm = nts.RigidBody.from_inertia(2.0, (0.1, 0.2, 0.25), (5, 0, 0), name="arm", comm=COMM,
                                     angular_velocity=(0, 0, 3))  # fmt: skip
    hinge = nts.Revolute(arm, None, point=(5, 0, 0), axis=(0, 0, 1), name="hinge")
    pair = nts.ContactPair(
        slave=left.surface(lambda x: x[0] > 1 - 1e-9),
        master=right.surface(lambda x: x[0] < 1.004 + 1e-9), friction=0.3,
    )  # fmt: skip
    spring = nts.TorsionSpring.about(hinge, stiffness=4.0, angle=0.0, name="spring")
    system = nts.System([left, right, arm], contacts=[pair], joints=[hinge, spring])
    found = nts.simulate(system, nts.GeneralizedAlpha(), dt=1e-3, t_end=END)
    found.switches.extend([Switch(1e-3, "left against right", 5, (0, 1), -0.25)])
    found.warn("invented", 2e-3, 0.5, "half a joule is missing; look for it")
    return found


@pytest.fixture(scope="module")
def path(run, tmp_path_factory):
    """File of the run; the folder is rank 0's."""
    folder = COMM.bcast(tmp_path_factory.mktemp("saved"))
    run.save(folder / "new" / NAME)
    return folder / "new" / NAME


@pytest.mark.mpi
def test_tables_and_sentences_are_those_of_the_run(run, path):
    found = nts.load(path)
    assert repr(found) == f"<Saved: {run.summary}>"
    assert found.status == "completed" and "half a joule" in found.summary
    assert list(found.switches) == list(run.switches) and found.switches.worst.defect == -0.25
    assert dict(found.warnings) == dict(run.warnings)
    for mine, theirs in ((run.balance, found.balance), (run.reactions, found.reactions)):
        assert list(mine) == list(theirs)
        assert all(np.array_equal(mine[name], theirs[name]) for name in mine)
    assert list(found.reactions)[:4] == ["left", "right", "arm", "hinge"]
    assert np.array_equal(found.contact_forces, run.contact_forces)
    assert found.contact_forces[-1, 0, 0] < 0 < len(found.contact_moments)
    assert found.settings["integrator"] == repr(nts.GeneralizedAlpha())
    assert (found.settings["dt"], found.settings["t_end"]) == (1e-3, END)
    assert found.settings["ranks"] == COMM.size
    assert found.versions["dolfinx_nts"] == nts.__version__


@pytest.mark.mpi
def test_states_are_those_of_the_run(run, path):
    """Rows are matched by the nodes' places in the reference configuration."""

    def ordered(reference, *values):
        order = np.lexsort(np.round(reference, 6).T)
        return [v[order] for v in (reference, *values)]

    found, state = nts.load(path), run.state
    assert found.time == state.time
    for k, body in enumerate(run.system.bodies):
        parts = (body.reference, state.u[k], state.v[k], state.a[k])
        mine = [np.concatenate(COMM.allgather(p)).reshape(-1, 3) for p in parts]
        theirs = [found.bodies[body.name][name] for name in ("reference", "u", "v", "a")]
        for a, b in zip(ordered(*mine), ordered(*theirs), strict=True):
            assert np.array_equal(a, b)
    contact = found.contacts[0]
    force = COMM.allreduce(state.contacts[0].force.sum())
    assert contact["force"].sum() == pytest.approx(force, rel=1e-14) and force > 0
    assert len(contact["number"]) == 4
    turned = found.joints["spring"]["value"]
    assert np.abs(turned).max() == pytest.approx(3 * END, rel=1e-3)


@pytest.mark.mpi
def test_an_equilibrium_is_saved_too(tmp_path):
    mesh = create_box(COMM, [np.zeros(3), np.ones(3)], [1, 1, 1], CellType.hexahedron)
    held = nts.Dirichlet(lambda x: x[2] < 1e-9, value=(0, 0, 0))
    body = nts.Continuum(
        mesh, nts.StVenantKirchhoff(1e6, 0.3), density=1e3, bcs=[held], name="block"
    )
    path = COMM.bcast(tmp_path) / NAME
    settled = nts.equilibrium(nts.System([body], gravity=(0, 0, -9.81)), load_steps=2)
    settled.save(path)
    found = nts.load(path)
    assert found.settings["load_steps"] == [0.5, 1.0]
    assert found.settings["newton"] == repr(nts.Newton()) and found.settings["integrator"]
    assert repr(settled).startswith("<Equilibrium: completed: 2 steps")
    assert found.reactions["block"][-1, 0] == pytest.approx((0, 0, 9810.0), abs=1e-5)
    assert found.bodies["block"]["u"][:, 2].min() < 0 == np.abs(found.bodies["block"]["v"]).max()


def test_a_plot_is_made_without_the_scene(path, tmp_path):
    nts.load(path).plot(tmp_path / "balance.png")
    assert (tmp_path / "balance.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.mpi
def test_other_files_are_refused(run, path, tmp_path):
    folder = COMM.bcast(tmp_path)
    with pytest.raises(TypeError, match=r"^path=3: pass a path"):
        nts.load(3)
    with pytest.raises(TypeError, match=r"^path=3: pass a path"):
        run.save(3)
    with pytest.raises(FileNotFoundError, match=r"no.h5'?: there is no such file; pass the path"):
        nts.load(folder / "no.h5")
    with pytest.raises(ValueError, match=r"it is no checkpoint; pass the path that Checkpoint had"):
        nts.restart(path, run.system)
    if COMM.rank == 0:
        (folder / "text.h5").write_text("no HDF5")
        with h5py.File(folder / "old.h5", "w") as file:
            file.attrs.update(format="dolfinx_nts solution", version=1, package="0.0.1")
            file["notes"] = json.dumps({})
        with h5py.File(folder / "other.h5", "w") as file:
            file["numbers"] = np.zeros(3)
    COMM.barrier()
    with pytest.raises(OSError, match=r"^path='.*text\.h5'"):
        nts.load(str(folder / "text.h5"))
    with pytest.raises(ValueError, match=r"version 1, .* read it with dolfinx_nts 0\.0\.1"):
        nts.load(folder / "old.h5")
    with pytest.raises(ValueError, match=r"it holds no saved run; pass the path that Solution"):
        nts.load(folder / "other.h5")
