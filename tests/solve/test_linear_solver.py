"""The choice of the linear solver, and the way back when it was wrong."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from lines import interval_mesh, straight
from measures import difference
from petsc4py import PETSc

import dolfinx_nts as nts
from dolfinx_nts.equations import node_blocks
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.solve import fieldsplit, linear_solver
from dolfinx_nts.solve.presets import Presets

COMM = MPI.COMM_WORLD


def pressed_block(poisson, n=5, comm=COMM):
    """A block that trembles on a floor, of more coordinates than MUMPS is chosen for."""
    mesh = create_box(comm, [[0, 0, 0], [1, 1, 1]], [n, n, n + 1], CellType.hexahedron)
    block = nts.Continuum(
        mesh, nts.NeoHookean(young=1e6, poisson=poisson), density=1e3, name="block",
        velocity=lambda x: np.array([0.1 * x[2], 0 * x[0], 0.1 * np.sin(np.pi * x[0])]),
    )  # fmt: skip
    floor = nts.Plane((0, 0, -0.001), (0, 0, 1))
    pair = nts.ContactPair(block.surface(lambda x: x[2] < 1e-9), floor)
    return nts.System([block], contacts=[pair], gravity=(0, 0, -9.81))


def stepper_of(system, **options):
    return nts.Stepper(system, nts.EnergyMomentum(), newton=nts.Newton(**options))


@pytest.mark.parametrize(
    ("size", "contact", "inertia", "given", "preset"),
    [
        (600, True, True, {}, "krylov"),
        (599, True, True, {}, "direct"),
        (100, False, True, {}, "krylov"),
        (99, False, True, {}, "direct"),
        (50_000, True, True, {"snes_linesearch_type": "bt"}, "krylov"),
        (10_000, True, False, {}, "multigrid"),
        (9_999, False, False, {}, "direct"),
        (50_000, True, False, {"mat_mumps_icntl_7": 4}, "direct"),
        (50_000, True, True, {"mat_mumps_icntl_7": 4}, "direct"),
        (50_000, True, True, {"snes_linesearch_type": "bt", "ksp_type": "cg"}, "direct"),
    ],
)
def test_choice(size, contact, inertia, given, preset):
    assert linear_solver.choose(size, contact, inertia, given) == preset


@pytest.mark.slow
@pytest.mark.mpi
def test_krylov_is_left_where_it_is_slow_and_tried_again(caplog):
    """A nearly incompressible block at steps in which waves pass it ten times, then at short ones.

    Krylov's method alone cannot solve these steps.
    """
    caplog.set_level("INFO", logger="dolfinx_nts.solve.newton")
    long, short = 0.06, 5e-4
    tables = {}
    for solver in ("auto", "direct"):
        stepper = stepper_of(pressed_block(0.49), linear_solver=solver)
        for dt in [long] * 2 + [short] * 12:
            stepper.advance(dt)
        tables[solver] = stepper.solution.balance
        assert stepper.solution.retries == 0
        again = stepper.solver.snes.getKSP().getType()
        assert again == {"auto": "fgmres", "direct": "preonly"}[solver]
        stepper.close()
    assert len([r for r in caplog.records if "linear solver 'direct'" in r.getMessage()]) == 1
    assert difference(tables["auto"], tables["direct"]) < 1e-9
    krylov = stepper_of(pressed_block(0.49), linear_solver="krylov", max_retries=0)
    with pytest.raises(nts.StepFailedError):
        krylov.advance(long)
    krylov.close()


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_mumps_gets_more_workspace_where_it_runs_out_of_it(caplog, capfd):
    """A twentieth of what it guesses is too little: it gets more once, and nobody is told."""
    caplog.set_level("INFO", logger="dolfinx_nts")
    tables, workspaces = [], []
    for options in ({"mat_mumps_icntl_14": -95}, {}):
        newton, scheme = nts.Newton(linear_solver="direct", condense=False), nts.EnergyMomentum()
        scene = pressed_block(0.3, n=3)
        stepper = nts.Stepper(scene, scheme, newton=newton, petsc_options=options)
        for _ in range(5):
            stepper.advance(5e-3)
        tables.append(stepper.solution.balance)
        factors = stepper.solver.snes.getKSP().getPC().getFactorMatrix()
        workspaces.append((factors.getMumpsIcntl(14), factors.getMumpsInfog(1)))
        assert stepper.solution.retries == 0
        stepper.close()
    assert workspaces == [(400, 0), (80, 0)]
    assert tables[1]["active"].max() > 0 and difference(*tables) < 1e-12
    assert not caplog.records and capfd.readouterr() == ("", "")


def touching(comm, petsc_options=None, **options):
    """Stepper of a block in the first step with all its nodes on the floor."""
    newton = nts.Newton(linear_solver="krylov", **options)
    system, scheme = pressed_block(0.3, comm=comm), nts.EnergyMomentum()
    stepper = nts.Stepper(system, scheme, newton=newton, petsc_options=petsc_options)
    for _ in range(40):
        stepper.advance(1e-3)
        if stepper.solution.rows[-1]["active"] >= 30:
            return stepper
    raise AssertionError("no contact")


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_schur_complement_is_the_same_on_all_ranks_and_when_made_again():
    norms = []
    for comm in (COMM, MPI.COMM_SELF):
        stepper = touching(comm)
        for _ in range(2):
            schur = stepper.solver.matrix.schur()
            norms.append([schur.first.norm(), schur.second.norm()])
        stepper.close()
    assert np.all(np.ptp(norms, axis=0) <= 1e-9 * np.array(norms[0]))


@pytest.mark.parametrize("condense", [True, False])
@pytest.mark.parametrize("blocked", [True, False])
@pytest.mark.fast("True-True")
def test_schur_complements_are_those_of_the_operator(blocked, condense):
    """Against dense matrices; the bodies' part is that of the last fresh assembly."""
    options = {} if blocked else {"fieldsplit_bodies_pc_type": "gamg"}
    stepper = touching(COMM, options, condense=condense)
    problem, matrix = stepper.problem, stepper.solver.matrix
    e = problem.evaluate(problem.x)
    tangents = [part.tangent for part in e.parts]
    points = np.unique(np.concatenate([c.dofs()[0] for c in problem.elements]))
    rows = points[points >= 0]

    def parts():
        blocks = [matrix.operator.getNestSubMatrix(i, j) for i in range(2) for j in range(2)]
        return [m.getValues(*map(range, m.getSize())) for m in blocks]

    assert matrix.operator.getNestSubMatrix(0, 0).getType() == ("seqbaij" if blocked else "seqaij")
    for _ in range(2):
        problem.tangents.at(e)
        matrix.assemble(tangents, fresh=True)
        a = parts()[0][np.ix_(rows, rows)]
        w = 1.0 / np.abs(a).sum(axis=1)
        for factor in (1.0, 1.7):
            matrix.assemble([factor * t for t in tangents], fresh=factor == 1.0)
            schur, (_, b, c, d) = matrix.schur(), parts()
            b, c = w[:, None] * b[rows], c[:, rows]
            for found, expected in (
                (schur.first, d - c @ b),
                (schur.second, d - c @ (w[:, None] * (a @ b))),
            ):
                values = found.getValues(*map(range, found.getSize()))
                assert np.abs(values - expected).max() <= 1e-13 * np.abs(expected).max()
                assert found.getInfo()["mallocs"] == 0
    stepper.close()


def test_schur_complement():
    """Against the exact one: positive, and nearer than that of the inverted diagonal."""
    stepper = touching(COMM)
    matrix = stepper.solver.matrix
    schur = matrix.schur()
    blocks = [matrix.operator.getNestSubMatrix(i, j) for i in range(2) for j in range(2)]
    a, b, c, d, first, second = (
        m.getValues(*map(range, m.getSize())) for m in (*blocks, schur.first, schur.second)
    )
    exact = d - c @ np.linalg.solve(a, b)
    factors = np.linalg.inv(first)
    spreads = []
    for inverse in (factors @ second @ factors, np.linalg.inv(d - c / np.diag(a) @ b)):
        values = np.linalg.eigvals(inverse @ exact)
        assert np.abs(values.imag).max() < 1e-9 and values.real.min() > 0
        spreads.append(values.real.max() / values.real.min())
    assert spreads[0] < 2 < 4 < spreads[1]

    fieldsplit.set_schur(stepper.solver.snes, schur)
    part = stepper.solver.snes.getKSP().getPC()
    part.setUp()
    x, y = schur.first.createVecs()
    x.setRandom()
    part.getFieldSplitSubKSP()[1].getPC().apply(x, y)
    assert np.abs(y.array - factors @ second @ factors @ x.array).max() < 1e-12 * y.norm()
    for each in (x, y):
        each.destroy()
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize("condense", [False, True])
@pytest.mark.fast("True")
@pytest.mark.fast_on_ranks()
def test_contact_part_by_a_solver_of_the_user(condense):
    """LU of the first approximation alone: zeros on its diagonal need MUMPS unless condensed."""
    tables = []
    for options in (None, {"fieldsplit_constraints_pc_type": "lu"}):
        newton = nts.Newton(linear_solver="krylov", condense=condense, max_retries=0)
        run = nts.simulate(
            pressed_block(0.3), nts.EnergyMomentum(), dt=1e-3, t_end=0.02, newton=newton,
            petsc_options=options,
        )  # fmt: skip
        assert run.status == "completed" and run.balance["active"].max() > 0
        tables.append(run.balance)
    assert difference(*tables) < 1e-9


def test_who_failed_is_told():
    newton = nts.Newton(linear_solver="krylov", max_retries=0)
    options = {"ksp_max_it": 1, "ksp_rtol": 1e-14}
    run = nts.simulate(
        pressed_block(0.3), nts.EnergyMomentum(), dt=1e-3, t_end=2e-3, newton=newton,
        petsc_options=options,
    )  # fmt: skip
    told = "the linear solver 'krylov' failed, KSP reason -3, with petsc_options={'ksp_max_it': 1, "
    assert told in run.status and "linear_solver='auto'" in run.status


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "masters"),
    [(1, ()), (4, ()), (4, ("mesh",)), (4, ("sphere",)), (4, ("mesh", "sphere"))],
)
@pytest.mark.fast("1-masters0")
def test_matrix_in_blocks_of_nodes(cells, masters):
    """Against AIJ made by way of a nest, with nodes that are held along some axes.

    Of one cell some ranks own no node.
    """
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [cells] * 3, CellType.hexahedron)
    held = [
        nts.Dirichlet(lambda x: x[0] < 1e-9, components=(0,)),
        nts.Dirichlet(lambda x: x[1] < 1e-9, components=(0, 1)),
    ]
    rubber, velocity = nts.NeoHookean(young=1e6, poisson=0.3), (0, 0, -0.5)
    block = nts.Continuum(mesh, rubber, density=1e3, velocity=velocity, bcs=held, name="block")
    top = create_box(COMM, [[0, 0, -1.0005], [1.1, 1.1, 0]], [5, 5, 5], CellType.hexahedron)
    other = nts.Continuum(top, rubber, density=1e3, name="other")
    slave = block.surface(lambda x: x[2] < 1e-9)
    master = {
        "mesh": other.surface(lambda x: x[2] > -1e-9),
        "sphere": nts.Sphere((0.4, 0.4, -4.001), 4.0),
    }
    pairs = [nts.ContactPair(slave, master[name], friction=0.3) for name in masters]
    stepper = stepper_of(nts.System([block, other], contacts=pairs), linear_solver="krylov")
    for _ in range(10):
        stepper.advance(1e-3)
    contact = bool(masters)
    assert contact == (stepper.solution.rows[-1]["active"] > 1)
    matrix = stepper.solver.matrix
    bodies = matrix.operator.getNestSubMatrix(0, 0) if contact else matrix.operator
    assert bodies.getType().endswith("baij") and bodies.getInfo()["mallocs"] == 0
    problem = stepper.problem
    e = problem.evaluate(problem.x)
    other = StepMatrix(problem.laid.layout, problem.tangents.at(e), problem.laid.blocks, split=True)
    tangents = [part.tangent for part in e.parts] if problem.laid.blocks else []
    matrix.assemble(tangents, fresh=True)
    other.assemble(tangents)
    x, y, z = (problem.x.duplicate() for _ in range(3))
    x.array_w[:] = np.random.default_rng(COMM.rank).uniform(-1, 1, len(x.array_r))
    other.operator.mult(x, z)
    for _ in range(3):
        matrix.operator.mult(x, y)
        error = COMM.allreduce(np.abs(y.array_r - z.array_r).max(initial=0.0), op=MPI.MAX)
        assert error <= 1e-14 * z.norm()
        # Contact of other iterates, and of this one again.
        matrix.assemble([2.0 * a for a in tangents], fresh=False)
        matrix.assemble([0.5 * a for a in tangents], fresh=False)
        matrix.assemble(tangents, fresh=False)
    other.destroy()
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize(("missing", "whole"), [(None, True), ("row", False), ("column", False)])
def test_blocks_that_are_not_whole_are_found_on_all_ranks(missing, whole):
    nodes = 4 if COMM.rank == 0 else 1
    a = PETSc.Mat().createAIJ(((3 * nodes, None), (3 * nodes, None)), nnz=12, bsize=3, comm=COMM)
    start, _ = a.getOwnershipRange()
    for i in range(nodes):
        rows = start + 3 * i + np.arange(3, dtype=PETSc.IntType)
        # Of the last node on the first rank alone, coupling to the first node.
        near = np.arange(3, dtype=PETSc.IntType)
        a.setValues(rows, rows, np.eye(3))
        if COMM.rank == 0 and i == nodes - 1:
            rows, near = rows[missing == "row" :], near[missing == "column" :]
            a.setValues(rows, near, np.ones((len(rows), len(near))))
    a.assemble()
    found = node_blocks.patterns([a, a])
    assert (found is not None) == whole
    a.destroy()


def test_rows_that_are_whole_only_one_after_another():
    """Of two nodes x, and y and z, have blocks in other columns, in the same order."""
    a = PETSc.Mat().createAIJ(((9, None), (9, None)), nnz=9, bsize=3, comm=MPI.COMM_SELF)
    columns = {0: [0, 1], 1: [0], 2: [0], 3: [2], 4: [1, 2], 5: [1, 2], 6: [2], 7: [2], 8: [2]}
    for row, nodes in columns.items():
        for node in nodes:
            a.setValues(row, np.arange(3 * node, 3 * node + 3, dtype=PETSc.IntType), np.ones(3))
    a.assemble()
    assert node_blocks.patterns([a]) is None
    a.destroy()


def test_what_diverges_does_not_reach_held_coordinates():
    """Blocks of an element whose second node is held along y, and third node altogether."""
    a = PETSc.Mat().createBAIJ(((9, None), (9, None)), 3, nnz=3, comm=MPI.COMM_SELF)
    numbers = np.array([[3, 4, 5, 0, -1, 2, -1, -1, -1]])
    values = np.random.default_rng(0).uniform(1, 2, (1, 9, 9))
    expected = np.zeros((9, 9))
    free = np.flatnonzero(numbers[0] >= 0)
    expected[np.ix_(numbers[0, free], numbers[0, free])] = values[0][np.ix_(free, free)]
    values[0, numbers[0] < 0], values[0, :, numbers[0] < 0] = np.nan, np.nan
    sums = node_blocks.NodeSums(np.arange(9), numbers)
    sums.add(a, sums.of(values))
    a.assemble()
    whole = a.getValues(range(9), range(9))
    assert np.array_equal(whole, expected) and a.getInfo()["mallocs"] == 0
    a.destroy()


def thrown_cubes(comm, *cells):
    """Cubes in a row, the first thrown at the others."""
    hexahedron = CellType.hexahedron
    bodies = [
        nts.Continuum(
            create_box(comm, [[1.01 * k, 0, 0], [1.01 * k + 1, 1, 1]], [n] * 3, hexahedron),
            nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, name=f"cube {k}",
            velocity=(3.0 if k == 0 else 0.0, 0.1 * k, 0.0),
        )
        for k, n in enumerate(cells)
    ]  # fmt: skip
    contacts = [
        nts.ContactPair(
            slave=bodies[k].surface(lambda x, end=1.01 * k + 1: x[0] > end - 1e-9),
            master=bodies[k + 1].surface(lambda x, end=1.01 * k + 1.01: x[0] < end + 1e-9),
            friction=0.2,
        )
        for k in range(len(bodies) - 1)
    ]
    return nts.System(bodies, contacts=contacts)


@pytest.mark.mpi
@pytest.mark.parametrize("reuse", [False, True])
@pytest.mark.fast("True")
@pytest.mark.fast_on_ranks()
def test_as_many_bodies_as_ranks_need_no_more_iterations_than_one_rank(reuse):
    counts, energy = [], []
    for comm in (COMM, MPI.COMM_SELF):
        system = thrown_cubes(comm, *[6] * max(2, COMM.size))
        stepper = stepper_of(system, linear_solver="krylov", reuse=reuse)
        count = 0
        for _ in range(10):
            stepper.advance(1e-3)
            count += stepper.solver.snes.getLinearSolveIterations()
        assert stepper.solution.rows[-1]["active"] > 0
        counts.append(count)
        energy.append(stepper.solution.balance["energy"])
        stepper.close()
    # Rounding may ask for one more in each of the ten steps.
    assert counts[0] <= 1.1 * counts[1] + 10
    assert np.abs(energy[0] / energy[1] - 1).max() < 1e-10


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "ranks"), [((4, 4), (1, 2)), ((4, 6), (1,)), ((3, 3, 3, 3), (1, 2, 4))]
)
@pytest.mark.fast("cells0-ranks0", "cells1-ranks1")
def test_bodies_are_dealt_to_ranks_where_they_divide_evenly(cells, ranks):
    stepper = stepper_of(thrown_cubes(COMM, *cells), linear_solver="krylov")
    for _ in range(2):
        stepper.advance(1e-3)
    matrix = stepper.solver.matrix
    own = matrix.whole_bodies()
    assert (own is not None) == (COMM.size in ranks)
    if own is not None:
        parts = [n for part in COMM.allgather(own) for n in part]
        assert sorted(map(len, parts)) == sorted(3 * (n + 1) ** 3 for n in cells)
        assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(stepper.system.size))
    stepper.close()


@pytest.mark.slow
@pytest.mark.mpi
def test_a_pattern_that_grows_under_another_run_of_the_same_scene():
    """MUMPS adds the contact of a smooth master's nodes to the matrices that both runs share."""
    low = create_box(COMM, [[-0.5, -0.5, -0.5], [1.5, 1.5, 0]], [7, 7, 2], CellType.hexahedron)
    high = create_box(COMM, [[0, 0, 0.0005], [1, 1, 1]], [5, 5, 4], CellType.hexahedron)
    rubber, fixed = nts.NeoHookean(young=1e6, poisson=0.3), lambda x: x[2] < -0.5 + 1e-9
    base = nts.Continuum(low, rubber, density=1e3, bcs=[nts.Dirichlet(fixed)], name="base")
    cube = nts.Continuum(high, rubber, density=1e3, velocity=(0.3, 0.1, -0.3), name="cube")
    slave = cube.surface(lambda x: x[2] < 0.0005 + 1e-9)
    master = base.surface(lambda x: x[2] > -1e-9, smoothing=True)
    system = nts.System([base, cube], contacts=[nts.ContactPair(slave, master, friction=0.2)])
    # With matrices of their own in each iteration both have the same iterates.
    alone = stepper_of(system, linear_solver="krylov", reuse=False)
    for _ in range(5):
        alone.advance(1e-3)
    alone.close()
    beside = stepper_of(system, linear_solver="krylov", reuse=False)
    direct = nts.Stepper(system, nts.Midpoint(), newton=nts.Newton(linear_solver="direct"))
    for _ in range(5):
        beside.advance(1e-3)
        direct.advance(1e-3)
    steps = list(zip(alone.solution.rows, beside.solution.rows, strict=True))
    assert max(row["active"] for row in alone.solution.rows) > 0
    for expected, found in steps:
        assert found["potential"] == pytest.approx(expected["potential"], rel=1e-9, abs=0)
    for stepper in (beside, direct):
        stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize("condense", [False, True])
@pytest.mark.slow
def test_the_choice_changes_no_solution(condense):
    tables = []
    for solver, condensed in (("auto", condense), ("direct", False)):
        newton = nts.Newton(linear_solver=solver, condense=condensed)
        run = nts.simulate(
            pressed_block(0.3), nts.EnergyMomentum(), dt=1e-3, t_end=0.04, newton=newton
        )
        assert run.status == "completed"
        assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["energy"].max()
        tables.append(run.balance)
    assert tables[0]["active"].max() >= 30 and difference(*tables) < 1e-9


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "fine", "friction"),
    [
        (nts.Midpoint(), 1, (0.3, 0.0)), (nts.EnergyMomentum(), 1, (0.0, 0.3)),
        (nts.EnergyMomentum(), 1, (0.3, 0.3)), (nts.EnergyMomentum(), 2, (0.3, 0.3)),
    ],
    ids=["floor", "wall", "both", "fine"],
)  # fmt: skip
@pytest.mark.fast("both")
@pytest.mark.fast_on_ranks()
def test_nodes_with_more_constraints_than_coordinates(integrator, fine, friction):
    """A block slides along a floor into a wall: nodes of its edge stick to one and touch both.

    The finer one has coordinates enough to begin with Krylov's method. How the two share a node's
    force is not determined, so rounding, which differs with processor and ranks, decides whether
    Newton needs a halved step (seen on 2 ranks with friction on both).
    """
    n = [4 * fine, 2 * fine, 2 * fine]
    mesh = create_box(COMM, [[0, 0, 0], [0.4, 0.2, 0.2]], n, CellType.hexahedron)
    rubber = nts.StVenantKirchhoff(young=1e6, poisson=0.3)
    block = nts.Continuum(mesh, rubber, density=1e3, velocity=(2, 0, 0), name="block")
    floor, wall = nts.Plane((0, 0, 0), (0, 0, 1)), nts.Plane((0.42, 0, 0), (-1, 0, 0))
    pairs = [
        nts.ContactPair(block.surface(lambda x: x[2] < 1e-9), floor, friction=friction[0]),
        nts.ContactPair(block.surface(lambda x: x[0] > 0.4 - 1e-9), wall, friction=friction[1]),
    ]
    system = nts.System([block], contacts=pairs, gravity=(0, 0, -9.81))
    run = nts.simulate(system, integrator, dt=1e-3, t_end=0.03)
    assert run.status == "completed" and run.retries <= 3 * (all(friction) and fine == 2)
    table = run.balance
    energy = table["energy"][0]
    assert table["active"].max() > 15 and table["friction_dissipation"][-1] > 1e-4 * energy
    assert table["min_gap"].min() > -1e-12
    if isinstance(integrator, nts.EnergyMomentum):
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy


def boxes(*kinds):
    """Boxes of these kinds that slide along a floor into a wall; edges of rigid ones repeat it."""
    floor, wall = nts.Plane((0, 0, 0), (0, 0, 1)), nts.Plane((0.42, 0, 0), (-1, 0, 0))
    rubber = nts.StVenantKirchhoff(young=1e6, poisson=0.3)
    bodies, pairs = [], []
    for y, kind in enumerate(kinds):
        ends = [[0, y, 0], [0.4, y + 0.2, 0.2]]
        mesh = create_box(COMM, ends, [2, 2, 2], CellType.hexahedron)
        options = {"density": 1e3, "velocity": (2, 0, 0), "name": kind}
        rigid = kind == "rigid"
        body = nts.RigidBody(mesh, **options) if rigid else nts.Continuum(mesh, rubber, **options)
        bodies.append(body)
        pairs += [
            nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), floor, friction=0.3),
            nts.ContactPair(body.surface(lambda x: x[0] > 0.4 - 1e-9), wall),
        ]
    return nts.System(bodies, contacts=pairs, gravity=(0, 0, -9.81))


@pytest.mark.parametrize(
    ("kinds", "inertia", "name"),
    [
        (("soft",), True, "direct"),
        (("soft",), False, "direct"),
        (("rigid",), True, "redundant"),
        (("rigid",), False, "redundant null-pivots"),
        (("rigid", "soft"), True, "redundant null-pivots"),
    ],
)
def test_equations_that_repeat_others_are_looked_for_where_there_may_be_some(kinds, inertia, name):
    presets = Presets(boxes(*kinds), nts.Newton(), "direct", {}, True, inertia)
    assert presets.name == name
    while (other := presets.alternative()) is not None:
        presets.use(other)
    assert presets.name == "null-pivots"


@pytest.mark.mpi
@pytest.mark.slow
def test_of_redundant_contacts_no_equation_repeats_another():
    """MUMPS finds none, and to look for some changes no solution."""
    tables = []
    for options in ({}, {"mat_mumps_icntl_24": 1, "mat_mumps_icntl_8": 77}):
        stepper = nts.Stepper(boxes("rigid"), nts.EnergyMomentum(), petsc_options=options)
        for _ in range(30):
            stepper.advance(1e-3)
            factors = stepper.solver.snes.getKSP().getPC().getFactorMatrix()
            assert factors.getMumpsInfog(28) == 0
            assert factors.getMumpsInfog(33) != 0, "nothing is scaled"
        assert stepper.solver.memory[0] == "redundant"
        tables.append(stepper.solution.balance)
        stepper.close()
    assert tables[0]["active"].max() == 18 and difference(*tables) < 1e-9


def test_the_users_own_solver_is_not_replaced():
    """It fails, the step is halved as often as allowed, and nothing else is tried."""
    options = {"ksp_type": "gmres", "ksp_max_it": 2, "pc_type": "jacobi", "ksp_rtol": 1e-9}
    newton = nts.Newton(max_retries=0)
    stepper = nts.Stepper(
        pressed_block(0.3), nts.EnergyMomentum(), newton=newton, petsc_options=options
    )
    with pytest.raises(nts.StepFailedError):
        stepper.advance(1e-3)
    assert stepper.solver.snes is None or stepper.solver.snes.getKSP().getType() == "gmres"
    stepper.close()


def test_tolerances_of_the_user_are_kept():
    krylov = nts.Newton(linear_solver="krylov")
    for options, kept in (({}, False), ({"ksp_rtol": 3e-7}, True)):
        stepper = nts.Stepper(
            pressed_block(0.3), nts.EnergyMomentum(), newton=krylov, petsc_options=options
        )
        stepper.advance(1e-3)
        found = stepper.solver.snes.getKSP().getTolerances()[0]
        assert (found == 3e-7) is kept and 1e-10 <= found <= 1e-5
        stepper.close()


def test_a_second_attempt_after_a_factorisation_that_failed(monkeypatch):
    """Of the first Schur complement only zeros are given to PETSc, which remembers the failure."""
    own, zeroed = StepMatrix.schur, []

    def schur(self):
        approximation = own(self)
        if not zeroed:
            approximation.first.zeroEntries()
            zeroed.append(True)
        return approximation

    monkeypatch.setattr(StepMatrix, "schur", schur)
    stepper = stepper_of(pressed_block(0.3), linear_solver="krylov", max_retries=0)
    for _ in range(30):
        stepper.advance(1e-3)
    assert zeroed and stepper.solution.retries == 0
    stepper.close()


# ---- chains of rigid bodies and beams
@pytest.mark.mpi
@pytest.mark.skipif(not PETSc.Sys.hasExternalPackage("suitesparse"), reason="needs KLU")
def test_chains_are_solved_as_by_mumps():
    """Beams and rigid bodies in joints, of which two repeat each other."""
    ends = []
    for options in (None, {"pc_factor_mat_solver_type": "mumps"}):
        rod = nts.Beam(
            interval_mesh(straight(6)),
            nts.Circle(0.02).section(young=1e9, poisson=0.3, density=1e3), name="rod",
        )  # fmt: skip
        links = [
            nts.RigidBody.from_inertia(1.0, (0.1, 0.2, 0.2), centre=(1.5 + k, 0, 0), name=f"l{k}")
            for k in range(2)
        ]
        joints = [
            nts.Revolute(None, rod, point=(0, 0, 0), axis=(0, 1, 0)),
            nts.Spherical(rod, links[0], point=(1, 0, 0)),
            nts.Revolute(*links, point=(2, 0, 0), axis=(0, 1, 0), name="one"),
            nts.Revolute(*links, point=(2, 0, 0), axis=(0, 1, 0), name="again"),
        ]
        system = nts.System([rod, *links], joints=joints, gravity=(0, 0, -9.81))
        stepper = nts.Stepper(system, nts.EnergyMomentum(), petsc_options=options)
        for _ in range(10):
            stepper.advance(5e-3)
        pc = stepper.solver.snes.getKSP().getPC()
        assert pc.getType() == ("lu" if options or COMM.size == 1 else "redundant")
        if pc.getType() == "lu":
            assert pc.getFactorSolverType() == ("mumps" if options else "klu")
        ends.append(np.array([link.position for link in links]))
        stepper.close()
    assert np.abs(ends[0] - ends[1]).max() < 1e-11
