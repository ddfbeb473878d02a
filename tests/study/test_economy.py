"""Only what a scene requires: what is off, far or idle costs nothing and changes nothing."""

import csv
import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
import two_blocks
from dolfinx.mesh import CellType, create_box
from integrators import MID_STEP
from measures import difference
from pairs import pairs
from petsc4py import PETSc
from processes import in_fresh_python
from scenes import rubbing_blocks

import dolfinx_nts as nts
from dolfinx_nts import petsc_compat
from dolfinx_nts.contact import search
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.forms import compile_forms
from dolfinx_nts.study import economy, tradeoff

COMM = MPI.COMM_WORLD
FEATURE = {f.name: f for f in economy.FEATURES}


def stepper(scene, name="energy-momentum", *, ledger=True, **newton):
    # One solver for all features, so that their rounding is the same.
    newton = {"linear_solver": "direct", **newton}
    return nts.Stepper(scene, MID_STEP[name], newton=nts.Newton(**newton), ledger=ledger)


def num_idle(s):
    """Elements of contacts without unknowns, of all ranks."""
    return COMM.allreduce(sum(c.num_elements for c in s.problem.couplings.contacts.idle))


def all_awake(monkeypatch):
    """Give every candidate unknowns, as if each could touch in every step."""
    everyone = lambda self, index, c, had: np.ones(c.num_elements, dtype=bool)  # noqa: E731
    monkeypatch.setattr(ContactSearch, "_may_touch", everyone)


def displacements(s):
    return np.concatenate(s.state.u)


def same(a, b):
    """To the bit; on several ranks MUMPS adds up in the order in which messages arrive."""
    return np.abs(a - b).max() <= (0.0 if COMM.size == 1 else 1e-13 * np.abs(b).max())


def factor_entries(s):
    return s.solver.snes.getKSP().getPC().getFactorMatrix().getMumpsInfog(9)


# ---- the table
@pytest.mark.slow
def test_table(tmp_path, capsys):
    arguments = ["economy", "--set", "cells=2", "steps=1", "rounds=2"]
    rows = tradeoff.main([*arguments, "--output", str(tmp_path)])
    assert [r["row"] for r in rows] == [economy.PLAIN, *FEATURE]
    for row in rows:
        for name in ("cpu [ms/step]", "wall [ms/step]", "iterations", "cpu ratio", "cpu / plain"):
            assert row[name] > 0, (row["row"], name)
        assert row["against"] in {r["row"] for r in rows}
    # What is compared with the plain loop takes as many iterations as that, but for rounding.
    assert np.ptp([r["iterations"] for r in rows[:5]]) <= 1
    lines = (tmp_path / "economy.csv").read_text().splitlines()
    assert lines[0].startswith("# economy") and len(list(csv.DictReader(lines[1:]))) == len(rows)
    assert "candidates, inactive" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["cells", "rounds"])
def test_table_of_nothing(name):
    with pytest.raises(ValueError, match=f"{name}=0"):
        economy.table(COMM, **{name: 0})


@pytest.mark.mpi
@pytest.mark.slow
def test_plain_loop_has_the_same_trajectory():
    scenes = economy.Economy(COMM, 2)
    plain = scenes.plain()
    s = stepper(scenes.system(FEATURE["declared, far"]), rtol=economy.RTOL)
    for _ in range(10):
        for body in plain:
            body.step()
        s.advance(scenes.dt)
    for u, v, body in zip(s.state.u, s.state.v, plain, strict=True):
        assert np.abs(u - body.u).max() <= 1e-10 * np.abs(u).max()
        assert np.abs(v - body.v).max() <= 1e-10 * np.abs(v).max()
        body.destroy()
    s.close()


def test_without_its_ledger_a_run_is_the_same():
    scenes = economy.Economy(COMM, 2)
    final = []
    for on in (True, False):
        s = stepper(scenes.system(FEATURE["active"]), ledger=on)
        for _ in range(4):
            s.advance(scenes.dt)
        s.close()
        assert np.isfinite(s.solution.balance["energy"][1:]).all() == on
        assert np.isfinite(s.solution.contact_forces).all()
        final.append(displacements(s))
    assert np.array_equal(*final)


def test_a_progress_line_and_a_table_without_a_ledger(capsys):
    scenes = economy.Economy(COMM, 2)
    run = nts.simulate(
        scenes.system(FEATURE["active"]), nts.Midpoint(), dt=scenes.dt, t_end=3 * scenes.dt,
        ledger=False, progress=True,
    )  # fmt: skip
    assert run.status == "completed" and "no ledger was kept" in run.summary
    assert np.isnan(run.balance["linear_momentum"][1:]).all()
    with pytest.raises(TypeError, match="ledger=0: pass True or False"):
        nts.Stepper(run.system, nts.Midpoint(), ledger=0)


# ---- far
@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("integrator", MID_STEP)
@pytest.mark.fast_on_ranks("energy-momentum-0.3")
@pytest.mark.fast("midpoint-0.0")
def test_far_bodies_have_neither_search_nor_contact_unknowns(monkeypatch, integrator, friction):
    scenes = economy.Economy(COMM, 2)
    feature = dataclasses.replace(FEATURE["declared, far"], friction=friction)
    far, alone = stepper(scenes.system(feature), integrator), None

    def called(*_, **__):
        raise AssertionError("fine search of far bodies")

    monkeypatch.setattr(search, "closest_facets", called)
    far.advance(scenes.dt)
    laid = far.problem.laid
    for _ in range(3):
        far.advance(scenes.dt)
    assert far.problem.laid is laid
    assert far.problem.laid.layout.counts.shape[1] == 2 and not far.problem.laid.blocks
    row, u = far.solution.rows[-1], displacements(far)
    far.close()
    alone = stepper(scenes.system(FEATURE["contact not declared"]), integrator)
    for _ in range(4):
        alone.advance(scenes.dt)
    assert same(u, displacements(alone)) and row["min_gap"] == np.inf
    assert same(row["energy"], alone.solution.rows[-1]["energy"])
    alone.close()


def test_apart_only_where_the_search_finds_nothing():
    rng, seen = np.random.default_rng(3), {True: 0, False: 0}
    for _ in range(60):
        points, corners = rng.random((5, 3)), rng.random((4, 4, 3)) + rng.uniform(-3, 3, 3)
        every = search.closest_facets(points, corners, reach=np.inf).distance.min()
        reach = every * rng.choice([0.2, 0.9, 1.0, 1.1])
        far = search.apart(points, corners, reach)
        seen[far] += 1
        assert not (far and reach >= every)
    assert min(seen.values()) > 10


# ---- idle candidates
@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("integrator", MID_STEP)
@pytest.mark.fast_on_ranks("energy-momentum-0.0")
@pytest.mark.fast("midpoint-0.3")
def test_idle_candidates_are_no_unknowns(monkeypatch, integrator, friction):
    """No unknown, no fill, no iteration; gaps and facets are known as if they were."""
    scenes = economy.Economy(COMM, 2)
    feature = dataclasses.replace(FEATURE["candidates, inactive"], friction=friction)
    near = stepper(scenes.system(feature), integrator)
    near.advance(scenes.dt)
    laid = near.problem.laid
    near.advance(scenes.dt)
    assert num_idle(near) == 9
    assert near.problem.laid is laid and near.problem.laid.layout.counts.shape[1] == 2
    fill, near_row = factor_entries(near), near.solution.rows[-1]
    near.close()

    bare = dataclasses.replace(FEATURE["contact not declared"], place="near")
    none = stepper(scenes.system(bare), integrator)
    all_awake(monkeypatch)
    awake = stepper(scenes.system(feature), integrator)
    for _ in range(2):
        none.advance(scenes.dt)
        awake.advance(scenes.dt)
    assert fill == factor_entries(none) < factor_entries(awake)
    assert same(displacements(near), displacements(none))
    gap = awake.state.contacts[0].gap
    assert near.state.contacts[0].gap == pytest.approx(gap, rel=1e-12, abs=1e-13)
    assert near_row["min_gap"] == pytest.approx(awake.solution.rows[-1]["min_gap"], rel=1e-12)
    none.close()
    awake.close()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("scene", "integrator"), zip(["smooth", "frictional"], MID_STEP, strict=True)
)
@pytest.mark.slow
def test_an_impact_is_the_same_as_with_all_candidates_awake(monkeypatch, integrator, scene):
    """Approach, impact and separation."""
    make = {
        "smooth": lambda: (two_blocks.scene(COMM), 2e-3, 18),
        "frictional": lambda: (rubbing_blocks(0.3), 2e-3, 18),
    }[scene]
    tables, idle = [], []
    for _ in range(2):
        system, dt, steps = make()
        s = stepper(system, integrator)
        for _ in range(steps):
            s.advance(dt)
            idle.append(num_idle(s))
        s.close()
        tables.append(s.solution.balance)
        all_awake(monkeypatch)
    assert tables[0]["active"].max() > 0 and max(idle[: len(idle) // 2]) > 0
    assert not any(idle[len(idle) // 2 :])
    assert difference(*tables) < 1e-9


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("master", "integrator", "friction"), pairs(["plane", "plate"], MID_STEP, [0.0, 0.3])
)
@pytest.mark.fast_on_ranks("plate-midpoint-0.3")
def test_idle_candidates_wake_in_the_step_that_closes_their_gap(
    monkeypatch, master, integrator, friction
):
    """A body at rest, so that no motion is predicted, that a force brings down within a step."""
    rubber, dt, fall = nts.NeoHookean(1e6, 0.3), 0.02, 0.5 * 9.81 * 0.02**2
    states = []
    for _ in range(2):
        box = [[0.1, 0.1, 0.5 * fall], [0.9, 0.9, 0.8]]
        cube = nts.Continuum(
            create_box(COMM, box, [2] * 3, CellType.hexahedron), rubber, density=1e3, name="cube",
            body_force=(0, 0, -9.81e3),
        )  # fmt: skip
        plate = nts.Continuum(
            create_box(COMM, [[0, 0, -1], [1, 1, 0]], [2] * 3, CellType.hexahedron), rubber,
            density=1e3, name="plate", bcs=[nts.Dirichlet(lambda x: x[2] < -1 + 1e-9)],
        )  # fmt: skip
        top = plate.surface(lambda x: x[2] > -1e-9)
        plane = nts.Plane((0, 0, 0), (0, 0, 1))
        bottom = cube.surface(lambda x: x[2] < 0.5 * fall + 1e-9)
        pair = nts.ContactPair(bottom, plane if master == "plane" else top, friction=friction)
        system = nts.System([cube, plate], contacts=[pair])
        s = stepper(system, integrator)
        s.problem.begin(s.state, dt)
        states.append(num_idle(s))
        s.advance(dt)
        assert s.solution.rows[-1]["active"] > 0
        assert s.solution.rows[-1]["min_gap"] > -1e-10
        states.append(displacements(s))
        s.close()
        all_awake(monkeypatch)
    assert states[0] == 9 and states[2] == 0
    assert np.abs(states[1] - states[3]).max() < 1e-9 * np.abs(states[3]).max()


# ---- what is off
def test_frictionless_contact_has_no_tangential_unknowns():
    scenes, counts = economy.Economy(COMM, 2), []
    for name in ("active", "friction, active"):
        s = stepper(scenes.system(FEATURE[name]))
        s.advance(scenes.dt)
        counts.append(int(s.problem.laid.layout.counts[:, 2:].sum()))
        s.close()
    assert counts == [9, 9 * 3]


@pytest.mark.mpi
def test_mass_matrix_without_zeros_is_the_same():
    body = economy.Economy(COMM, 2).system(FEATURE["active"]).bodies[0]
    full = petsc_compat.create_matrix(body_mass := mass_form(body))
    petsc_compat.assemble_matrix(full, body_mass, (), 0.0)
    x, y = full.createVecs()
    x.array_w[:] = np.random.default_rng(COMM.rank).standard_normal(body.num_owned)
    full.mult(x, y)
    assert np.array_equal(body.inertia(x.array_r), y.array_r)
    both = body._mass.matrix, full
    entries = [a.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"] for a in both]
    assert entries[0] == entries[1] / 3


def mass_form(body):
    import ufl

    v, w = ufl.TrialFunction(body.space), ufl.TestFunction(body.space)
    return compile_forms([body._rho * ufl.inner(v, w) * body._dx])[0]


def test_loads_are_assembled_when_they_change(monkeypatch):
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [1] * 3, CellType.hexahedron)
    for force, expected in (((0, 0, 0), 0), ((0, 0, 2), 1), (lambda t: (0, 0, 2 * t), 4)):
        body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e4, body_force=force)
        count, assemble = [], body._forms.assemble

        def counted(form, body=body, count=count, assemble=assemble):
            count.extend([1] if form is body._load_form else [])
            return assemble(form)

        monkeypatch.setattr(body._forms, "assemble", counted)
        s = stepper(nts.System([body]))
        for _ in range(4):
            s.advance(1e-2)
        assert len(count) == expected
        impulse = 2 * 0.04 if expected == 1 else 2 * 0.04**2 / 2 if expected else 0.0
        momentum = s.solution.rows[-1]["linear_momentum"][2]
        assert momentum == pytest.approx(impulse, rel=1e-10, abs=1e-14)
        s.close()


RUN = """
import sys
from mpi4py import MPI
import dolfinx, dolfinx.fem.petsc
before = set(sys.modules)
import dolfinx_nts as nts
from dolfinx.mesh import CellType, create_box
mesh = create_box(MPI.COMM_WORLD, [[0, 0, 0], [1, 1, 1]], [1] * 3, CellType.hexahedron)
cube = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3, velocity=(0, 0, -1), name="cube")
pair = nts.ContactPair(cube.surface(lambda x: x[2] < 1e-9), nts.Plane((0, 0, 0), (0, 0, 1)))
run = nts.simulate(nts.System([cube], contacts=[pair]), nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
assert run.status == "completed" and run.balance["active"].max() == 4
print("names:", *(set(sys.modules) - before))
"""


@pytest.mark.slow
def test_a_run_imports_nothing_that_is_off():
    names = in_fresh_python(RUN).split()
    loaded = {name.split(".")[0] for name in names}
    assert "dolfinx_nts" in loaded
    assert not loaded & {"matplotlib", "pyvista", "h5py", "tqdm", "gmsh"}
    modules = {name for name in names if name.startswith("dolfinx_nts.")}
    off = ("dolfinx_nts.output", "dolfinx_nts.study")
    assert not {name for name in modules if name.startswith(off)}
