"""Matrices of earlier iterates: fewer of them, the same solution."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from integrators import MID_STEP
from measures import difference
from scenes import RUBBER, at, box, rubbing_blocks

import dolfinx_nts as nts
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.solve.accuracy import ACCURACY

COMM = MPI.COMM_WORLD


def run(integrator, dt=2e-3, steps=30, system=None, **newton):
    """Balance table of a collision, and how often the bodies' matrices were assembled."""
    stepper = nts.Stepper(
        system or rubbing_blocks(0.3), MID_STEP[integrator], newton=nts.Newton(**newton)
    )
    assembled, problem = [], stepper.problem
    at = problem.tangents.at
    problem.tangents.at = lambda e: assembled.append(1) or at(e)
    for k in range(steps):
        stepper.advance((k + 1) * dt - stepper.state.time)
    stepper.close()
    return stepper.solution.balance, len(assembled)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "solver"), [("midpoint", "direct"), ("energy-momentum", "krylov")]
)
@pytest.mark.slow
def test_reuse_changes_no_solution(integrator, solver):
    table, every = run(integrator, linear_solver=solver, condense=True)
    again, some = run(integrator, linear_solver=solver, condense=True, reuse=True)
    assert table["active"].max() >= 4
    assert difference(table, again) < 1e-9
    if integrator == "energy-momentum":
        assert np.abs(again["ledger_residual"]).max() < 1e-11 * again["energy"][0]
    assert some < 0.5 * every
    assert again["newton_iterations"].sum() < 2 * table["newton_iterations"].sum()


@pytest.mark.mpi
@pytest.mark.parametrize("reuse", [False, True])
@pytest.mark.slow
def test_two_runs_of_one_system_in_turns_are_those_one_after_the_other(reuse):
    """Each finds the bodies' matrix changed by the other one, and makes it anew."""

    def ends(system, in_turns, dt=2e-3, steps=12):
        newton = nts.Newton(linear_solver="direct", condense=True, reuse=reuse)
        runs = [
            nts.Stepper(system, nts.EnergyMomentum(), newton=newton),
            nts.Stepper(system, nts.Midpoint(), newton=newton),
        ]
        both = [(k, run) for k in range(steps) for run in runs]
        for k, stepper in both if in_turns else sorted(both, key=lambda pair: runs.index(pair[1])):
            stepper.advance((k + 1) * dt - stepper.state.time)
        for stepper in runs:
            stepper.close()
        return [stepper.solution.balance for stepper in runs]

    system = rubbing_blocks(0.3)
    apart, mixed = ends(system, False), ends(system, True)
    # Ranks of MUMPS add up in the order in which their messages come.
    same = 0.0 if system.comm.size == 1 else 1e-12
    for one, other in zip(apart, mixed, strict=True):
        assert one["active"].max() >= 4
        assert difference(one, other) <= (1e-9 if reuse else same)


@pytest.mark.slow
@pytest.mark.mpi
def test_without_condensing_too():
    table, every = run("energy-momentum")
    again, some = run("energy-momentum", reuse=True)
    assert difference(table, again) < 1e-9
    assert some < 0.5 * every


def test_a_changed_step_makes_new_matrices():
    """dt is in the matrices, so that one of another dt would contract badly or not at all."""
    stepper = nts.Stepper(
        rubbing_blocks(0.0), nts.EnergyMomentum(), newton=nts.Newton(reuse=True, rtol=1e-10)
    )
    for dt in (1e-4, 1e-2, 1e-4, 1e-2):
        stepper.advance(dt)
        assert stepper.solution.rows[-1]["newton_iterations"] <= 8
    stepper.close()


@pytest.mark.parametrize("solver", ["direct", "krylov"])
@pytest.mark.slow
def test_a_step_without_its_last_contact_takes_the_matrices_on(solver):
    """The new layout gets its operator from the matrices kept."""
    mesh = create_box(COMM, [[0, 0, 0.05], [1, 1, 1]], [1] * 3, CellType.hexahedron)
    cube = nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=1e4, name="cube", velocity=(0, 0, -1)
    )
    bottom = cube.surface(lambda x: x[2] < 0.05 + 1e-9)
    pair = nts.ContactPair(bottom, nts.Plane((0, 0, 0), (0, 0, 1)))
    run = nts.simulate(
        nts.System([cube], contacts=[pair]), nts.EnergyMomentum(), dt=5e-3, t_end=0.9,
        newton=nts.Newton(reuse=True, condense=True, linear_solver=solver),
    )  # fmt: skip
    assert run.status == "completed" and run.retries == 0
    active, gap = run.balance["active"], run.balance["min_gap"]
    assert active.max() == 4 and active[-1] == 0 and np.isinf(gap[-1])


@pytest.mark.slow
def test_reuse_with_a_split_of_another_kind():
    """A user's own field split need not be a Schur complement."""
    options = {
        "ksp_type": "gmres",
        "ksp_rtol": 1e-8,
        "ksp_max_it": 500,
        "pc_type": "fieldsplit",
        "pc_fieldsplit_type": "multiplicative",
        "fieldsplit_bodies_pc_type": "bjacobi",
        "fieldsplit_constraints_pc_type": "jacobi",
    }
    runs = [
        nts.simulate(
            rubbing_blocks(0.3), nts.EnergyMomentum(), dt=2e-3, t_end=0.04,
            newton=nts.Newton(condense=True, reuse=reuse), petsc_options=options if reuse else None,
        )
        for reuse in (False, True)
    ]  # fmt: skip
    assert all(run.status == "completed" for run in runs)
    a, b = (run.balance for run in runs)
    assert a["active"].max() >= 4 and difference(a, b) < 1e-8


def test_steps_that_differ_by_rounding_share_their_matrices():
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [2, 2, 2], CellType.hexahedron)
    body = nts.Continuum(
        mesh,
        nts.NeoHookean(1e6, 0.3),
        density=1e5,
        name="cube",
        velocity=lambda x: 0.1 * x[[1, 2, 0]],
    )
    table, assembled = run(
        "energy-momentum", dt=1e-3, steps=50, system=nts.System([body]), reuse=True, rtol=1e-9
    )
    assert len(np.unique(np.diff(table["time"]))) > 1
    assert assembled <= 3


@pytest.mark.mpi
@pytest.mark.parametrize("condense", [False, True])
@pytest.mark.slow
def test_a_body_without_contact_beside_two_with(condense):
    """The blocks of a split have a place for it."""

    def scene():
        bodies = list((pair := rubbing_blocks(0.3)).bodies)
        mesh = create_box(COMM, [[9, 0, 0], [10, 1, 1]], [2, 2, 2], CellType.hexahedron)
        free = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3, name="free")
        return nts.System([bodies[0], free, bodies[1]], contacts=pair.contacts)

    krylov = nts.Newton(linear_solver="krylov", condense=condense)
    a, b = (
        nts.simulate(scene(), nts.EnergyMomentum(), dt=2e-3, t_end=0.05, newton=newton).balance
        for newton in (None, krylov)
    )
    assert a["active"].max() >= 4
    assert difference(a, b) < 1e-9


def test_a_failed_step_leaves_no_trace(monkeypatch):
    """After a step that diverged to NaN the next one starts from matrices of its own."""
    stepper = nts.Stepper(
        rubbing_blocks(0.3), nts.EnergyMomentum(), newton=nts.Newton(reuse=True, condense=True)
    )
    for _ in range(30):
        stepper.advance(1e-3)
    state, problem = stepper.state, stepper.problem
    evaluate = problem.evaluate

    def broken(*at):
        e = evaluate(*at)
        for c in e.parts:
            c.tangent[:] = np.nan
            c.residual[:] = np.nan
        return e

    monkeypatch.setattr(problem, "evaluate", broken)
    with pytest.raises(nts.StepFailedError):
        stepper.advance(1e-3)
    monkeypatch.setattr(problem, "evaluate", evaluate)
    assert stepper.state is state
    stepper.advance(1e-3)
    assert stepper.solution.rows[-1]["newton_iterations"] < 15
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("accuracy", "ledger"), [("exact", 1e-11), ("balanced", 1e-8), ("fast", 1e-5)]
)
@pytest.mark.fast("fast-1e-05")
@pytest.mark.fast_on_ranks()
def test_levels_of_accuracy_close_the_ledger_as_they_say(accuracy, ledger):
    scene, rule = rubbing_blocks(0.3), nts.EnergyMomentum()
    run = nts.simulate(scene, rule, dt=2e-3, t_end=0.08, accuracy=accuracy)
    assert run.status == "completed" and run.retries == 0
    energy = run.balance["energy"][0]
    assert np.abs(run.balance["ledger_residual"]).max() <= ledger * energy
    assert run.balance["friction_dissipation"][-1] > 0.005 * energy


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"accuracy": "perfect"}, "accuracy='perfect': choose one of 'exact', 'balanced', 'fast'"),
        ({"accuracy": "fast", "newton": nts.Newton()}, "pass one of them"),
    ],
)
def test_unknown_accuracy(options, message):
    with pytest.raises(ValueError, match=message):
        nts.simulate(rubbing_blocks(0.0), nts.Midpoint(), dt=1e-3, t_end=1.0, **options)


def thrown(spin):
    """A block of tetrahedra in flight, under gravity or turning."""
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 0.5]], [7, 7, 4], CellType.tetrahedron)
    block = nts.Continuum(
        mesh,
        nts.NeoHookean(1e6, 0.3),
        density=1e3,
        degree=1,
        velocity=lambda x: np.stack([3 - spin * (x[1] - 0.5), spin * (x[0] - 0.5), 0 * x[0]]),
    )
    ground = nts.Plane(point=(0, 0, -10), normal=(0, 0, 1))
    pair = nts.ContactPair(slave=block.surface(lambda x: x[2] < 1e-9), master=ground)
    return nts.System([block], contacts=[pair], gravity=(0, 0, -9.81))


def arch():
    """A block of tetrahedra falls on a smoothed arch of hexahedra and meets it in step 12."""
    ghosts = {"ghost_mode": GhostMode.shared_facet}
    half = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [14, 2, 4], CellType.hexahedron, **ghosts)
    t, r, z = (half.geometry.x[:, k].copy() for k in range(3))
    angle, r = np.pi * (1 - t), 0.8 + 0.2 * r
    half.geometry.x[:] = np.stack([r * np.cos(angle), 0.6 * (z - 0.5), r * np.sin(angle)], axis=1)
    rubber = nts.NeoHookean(1e6, 0.3)
    feet = nts.Dirichlet(lambda x: x[2] < 1e-9)
    below = nts.Continuum(half, rubber, density=1e3, bcs=[feet], name="arch")
    mesh = create_box(
        COMM, [[-0.15, -0.2, 1.01], [0.25, 0.2, 1.41]], [4] * 3, CellType.tetrahedron, **ghosts
    )
    block = nts.Continuum(mesh, rubber, density=1e3, velocity=(0.3, 0, -1), name="block")
    pair = nts.ContactPair(
        slave=block.surface(lambda x: x[2] < 1.01 + 1e-9),
        master=below.surface(lambda x: np.hypot(x[0], x[2]) > 0.99, smoothing=True),
    )
    return nts.System([block, below], contacts=[pair], gravity=(0, 0, -9.81))


@pytest.mark.mpi
@pytest.mark.parametrize(
    "system, steps, contact",
    [(lambda: thrown(0.0), 60, False), (lambda: thrown(2.0), 130, False), (arch, 16, True)],
    ids=["falling", "turning", "arch"],
)
@pytest.mark.fast_on_ranks("arch")
@pytest.mark.fast("falling")
def test_what_iterations_leave_does_not_add_up(system, steps, contact):
    """A hundredth of the 1e-8 that "balanced" may leave, where 100 such steps left all of it."""
    stepper = nts.Stepper(system(), nts.EnergyMomentum(), newton=ACCURACY["balanced"])
    for _ in range(steps):
        stepper.advance(1e-3)
    table = stepper.solution.balance
    stepper.close()
    assert table["active"].any() == contact
    assert np.abs(table["ledger_residual"]).max() < 1e-10 * table["energy"][0]


@pytest.mark.mpi
def test_lasting_contact_begins_closed():
    """Free flight would open it in every other step, by a bounce that does not come."""
    block = nts.Continuum(box((0, 0, 0), (1, 1, 1), 2), RUBBER, density=1e3, velocity=(0, 0, -2.0))
    pair = nts.ContactPair(block.surface(at(2, 0.0)), nts.Plane((0, 0, 0), (0, 0, 1)))
    stepper = nts.Stepper(nts.System([block], contacts=[pair]), nts.EnergyMomentum())
    problem, flies, carry = stepper.problem, 0, 0
    for _ in range(8):
        stepper.advance(2e-3)
        problem.begin(stepper.state, 2e-3)
        (first,) = problem.evaluate(problem.x).parts
        nodes = problem.elements[0].candidates.node
        carried = stepper.state.contacts[0].force[nodes] > 0.0
        assert first.active[carried].all()
        flies += int((first.gap[carried] > 1e-3).sum())
        carry += int(carried.sum())
    assert COMM.allreduce(carry) >= 9 and COMM.allreduce(flies) > 0
    stepper.close()


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_linear_solver_goes_as_far_as_kept_matrices_allow():
    """Those of a strain of 1e-6 are wrong by as much: two iterations gain twelve digits."""
    body = nts.Continuum(
        box(cells=4), nts.NeoHookean(1e6, 0.3), density=1e3, velocity=lambda x: 1e-6 * x
    )
    table, assembled = run(
        "energy-momentum", dt=1e-3, system=nts.System([body]), linear_solver="krylov", reuse=True
    )
    assert assembled == 1
    # The first step has yet to learn it; a third iteration may have rounding to take away.
    assert table["newton_iterations"][2:].max() <= 3
    assert np.abs(table["ledger_residual"]).max() < 1e-13 * table["energy"][0]


def test_the_step_is_the_same_number_in_all_steps():
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
    body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3, name="cube")
    lengths, system = [], nts.System([body])
    for start in (None, nts.simulate(system, nts.Midpoint(), dt=1e-3, t_end=0.03)):
        nts.simulate(
            system, nts.Midpoint(), dt=1.1e-3, t_end=0.1, start=start,
            before_step=lambda time, dt: lengths.append(dt),
        )  # fmt: skip
        assert len(set(lengths)) == 1
        lengths.clear()


@pytest.mark.mpi
@pytest.mark.slow
def test_runs_of_one_system_in_turn_use_no_matrix_of_each_other():
    """A body has one matrix; a run that took it of another step size would hardly converge."""
    system = rubbing_blocks(0.3)
    steps = {2e-3: 20, 1e-4: 20}

    def runs():
        newton = nts.Newton(reuse=True, rtol=1e-9)
        return {dt: nts.Stepper(system, nts.EnergyMomentum(), newton=newton) for dt in steps}

    alone, in_turn = runs(), runs()
    for dt, stepper in alone.items():
        for _ in range(steps[dt]):
            stepper.advance(dt)
    for _ in range(20):
        for dt, stepper in in_turn.items():
            stepper.advance(dt)
    for dt in steps:
        a, b = alone[dt].solution.balance, in_turn[dt].solution.balance
        assert difference(a, b) < 1e-9
        # Matrices made anew save some of them; rounding may ask for a few more.
        assert b["newton_iterations"].sum() <= 1.5 * a["newton_iterations"].sum()
        alone[dt].close()
        in_turn[dt].close()


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_what_rests_or_is_not_there_is_evaluated_once_a_step(monkeypatch):
    """Before the impact all iterates have a body in one place; nothing comes out otherwise.

    Its det F is sought at the start and in the first step, points of contacts are placed by the
    search and by the look at the end, and batches without elements are asked once.
    """
    tables, calls = [], []

    def counting(owner, name):
        method, count = getattr(owner, name), []
        setattr(owner, name, lambda *a, **k: count.append(1) or method(*a, **k))
        return count

    def turning(x):
        return np.array([2.0 + x[2], 0.0 * x[0], -x[0]])

    for remember in (True, False):
        left = nts.Continuum(box(), RUBBER, density=1e3, velocity=turning, name="left")
        right = nts.Continuum(box([1.02, 0, 0], [2.02, 1, 1], 3), RUBBER, density=1e3, name="right")
        pair = nts.ContactPair(left.surface(at(0, 1.0)), right.surface(at(0, 1.02)))
        system = nts.System([left, right], contacts=[pair])
        stepper = nts.Stepper(system, nts.EnergyMomentum())
        counts = [
            counting(right, "internal"), counting(right, "smallest_det"),
            counting(pair, "placed"), counting(stepper.problem._terms, "_evaluated"),
        ]  # fmt: skip
        if not remember:
            monkeypatch.setattr(Unknowns, "moves", lambda self, *_: [1.0] * len(self.awake))
        for _ in range(4):
            stepper.advance(1e-3)
        calls.append([len(count) for count in counts])
        for _ in range(8):
            stepper.advance(1e-3)
        tables.append(stepper.solution.balance)
        stepper.close()
    assert tables[0]["active"][4] == 0 and tables[0]["active"].max() >= 4
    assert calls[0] == [4, 2, 8, 4]
    assert all(kept < each for kept, each in zip(calls[0][:2], calls[1][:2], strict=True))
    # On several ranks two runs of MUMPS differ by rounding.
    assert difference(*tables) <= (0.0 if COMM.size == 1 else 1e-9)
