"""Scenes that trip contact codes: zero gap, edges, corners, held slaves, empty ranks, bounces.

A cube of one cell stands on, hits or leaves a plate of 2 x 2 facets whose top is z = 0.
"""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from integrators import MID_STEP
from petsc4py import PETSc
from scenes import RUBBER, everywhere

import dolfinx_nts as nts
from dolfinx_nts.solve import iterates

COMM = MPI.COMM_WORLD
ROUND_OFF = 1e-12
#: Lower left corner of the cube (edge 0.5): its four slaves lie inside facets, on edges of the
#: plate's facets, on their corners.
PLACES = {"inside": (0.2, 0.3), "edge": (0.5, 0.3), "corner": (0.5, 0.5), "across": (0.25, 0.25)}

pytestmark = pytest.mark.mpi
rubbing = pytest.mark.parametrize("friction", [0.0, 0.3])


@pytest.fixture(params=MID_STEP)
def integrator(request):
    return MID_STEP[request.param]


def scene(
    place="inside",
    gap=0.0,
    velocity=(0.0, 0.0, 0.0),
    *,
    cube=(),
    plate=(),
    cells=2,
    gravity=(0.0, 0.0, 0.0),
    plate_velocity=(0.0, 0.0, 0.0),
    friction=0.0,
):
    """Cube over plate; `cube` and `plate` are their Dirichlet conditions."""

    def box(low, high, n):
        kind = CellType.hexahedron
        return create_box(COMM, [low, high], n, kind, ghost_mode=GhostMode.shared_facet)

    x, y = PLACES[place]
    mesh = box((x, y, gap), (x + 0.5, y + 0.5, gap + 0.5), (1, 1, 1))
    options = {"density": 1e4, "material": RUBBER}
    cube = nts.Continuum(mesh, velocity=velocity, bcs=cube, name="cube", **options)
    plate_mesh = box((0.0, 0.0, -0.5), (1.0, 1.0, 0.0), (cells, cells, 1))
    plate = nts.Continuum(plate_mesh, velocity=plate_velocity, bcs=plate, name="plate", **options)
    slave = cube.surface(lambda x: x[2] < gap + 1e-9)
    pair = nts.ContactPair(slave, plate.surface(lambda x: x[2] > -1e-9), friction=friction)
    return nts.System([cube, plate], contacts=[pair], gravity=gravity)


def run(system, integrator, dt=2e-3, steps=8):
    """Run and check what holds in every scene; the balance table."""
    solution = nts.simulate(system, integrator, dt=dt, t_end=steps * dt)
    # The cube's only facet below may reach over the plate's rim.
    told = {w.kind for w in solution.warnings.grave} - {"contact inside a rim"}
    assert solution.status.startswith("completed") and not told
    assert solution.retries == 0
    table = solution.balance
    # No shorter step may be needed for what these scenes contain.
    assert len(table["time"]) == steps + 1
    scale = max(np.abs(table[k]).max() for k in ("energy", "external_work", "kinetic"))
    if integrator == MID_STEP["energy-momentum"]:
        assert np.abs(table["ledger_residual"]).max() <= ROUND_OFF * scale
    assert table["min_gap"].min() >= -ROUND_OFF
    if not COMM.allreduce(sum(len(b.fixed) for b in system.bodies)) and not system.gravity.any():
        for k in ("linear_momentum", "angular_momentum"):
            momentum = table[k]
            scale = max(1.0, np.abs(momentum).max())
            assert np.abs(momentum - momentum[0]).max() <= ROUND_OFF * scale
    return table


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.fast("midpoint-edge", "energy-momentum-corner", "energy-momentum-across")
@pytest.mark.fast_on_ranks("energy-momentum-corner")
def test_touching_at_rest_stays_at_rest(place, integrator):
    table = run(scene(place), integrator)
    assert np.abs(table["energy"]).max() <= 1e-20
    assert np.abs(table["min_gap"][1:]).max() <= ROUND_OFF


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.fast("midpoint-edge", "energy-momentum-corner", "energy-momentum-across")
@pytest.mark.fast_on_ranks("midpoint-edge")
def test_touching_and_sliding_takes_no_force(place, integrator):
    """Frictionless sliding over edges of facets, at zero gap all the time."""
    table = run(scene(place, velocity=(-2.0, -1.0, 0.0)), integrator, dt=5e-3)
    np.testing.assert_allclose(table["kinetic"], 3125.0, rtol=1e-9)
    assert np.abs(table["min_gap"][1:]).max() <= 1e-9


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.fast("midpoint-edge", "energy-momentum-corner", "energy-momentum-across")
@pytest.mark.fast_on_ranks("energy-momentum-corner")
def test_pressed_from_zero_gap(place, integrator):
    """A closed gap stays closed for a step, which throws the slaves back; nothing is lost by it."""
    table = run(scene(place, velocity=(0.0, 0.0, -1.0)), integrator)
    assert table["active"][1] == 4
    assert table["linear_momentum"][:, 2] == pytest.approx(-1250.0, rel=1e-11)
    if integrator == MID_STEP["energy-momentum"]:
        assert np.abs(table["contact_defect"]).max() <= ROUND_OFF * table["energy"][0]


@pytest.mark.parametrize(("place", "friction"), zip(PLACES, [0.3, 0.0, 0.3, 0.0], strict=True))
@pytest.mark.fast_on_ranks("energy-momentum-across-0.0")
def test_falls_onto_edges_and_corners(place, integrator, friction):
    table = run(scene(place, gap=0.003, velocity=(0.0, 0.0, -1.0), friction=friction), integrator)
    assert table["active"].max() == 4
    assert table["energy"][-1] <= table["energy"][0] * (1 + 1e-3)


@rubbing
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("energy-momentum-0.0")
def test_slides_off_the_end_of_the_plate(integrator, friction):
    """Slaves leave over the free edge while in contact; no facet is there to hold them."""
    system = scene("corner", velocity=(2.0, 0.0, -0.2), friction=friction)
    table = run(system, integrator, dt=1e-2, steps=30)
    assert table["active"][1:5].max() >= 2
    assert table["active"][-1] == 0


@pytest.mark.parametrize("master", ["free", "driven"])
@rubbing
@pytest.mark.fast("midpoint-0.3-driven", "energy-momentum-0.3-free")
@pytest.mark.fast_on_ranks()
def test_slaves_that_cannot_move(master, integrator, friction):
    """A wholly prescribed cube: the plate that comes up must give way."""
    below = nts.Dirichlet(lambda x: x[2] < -0.5 + 1e-9, lambda t: (0.0, 0.0, 0.5 * t))
    plate = {"plate_velocity": (0.0, 0.0, 0.5)} if master == "free" else {"plate": [below]}
    system = scene(gap=0.001, cube=[nts.Dirichlet(everywhere)], **plate, friction=friction)
    table = run(system, integrator, dt=4e-3, steps=20)
    assert table["active"].max() == 4


@pytest.mark.parametrize("gap", [0.0, 0.001])
@rubbing
@pytest.mark.fast(
    "energy-momentum-0.0-0.001", "energy-momentum-0.3-0.0", "midpoint-0.0-0.0",
    "midpoint-0.3-0.001",
)  # fmt: skip
@pytest.mark.fast_on_ranks("energy-momentum-0.3-0.0")
def test_nothing_can_move(gap, integrator, friction):
    held = [nts.Dirichlet(everywhere)]
    table = run(scene(gap=gap, cube=held, plate=held, friction=friction), integrator)
    assert not table["active"].any() and not table["energy"].any()


@rubbing
@pytest.mark.fast_on_ranks("energy-momentum-0.3")
def test_prescribed_slave_bottom_of_a_free_cube(integrator, friction):
    """Slave nodes held, the rest of their body free, the plate comes up against them."""
    held = [nts.Dirichlet(lambda x: x[2] < 0.001 + 1e-9)]
    system = scene(gap=0.001, cube=held, plate_velocity=(0.0, 0.0, 1.0), friction=friction)
    table = run(system, integrator)
    assert table["active"].max() == 4


@pytest.mark.parametrize("components", [(2,), (0, 1)])
@rubbing
@pytest.mark.fast("midpoint-0.3-components1", "energy-momentum-0.0-components0")
@pytest.mark.fast_on_ranks()
def test_slaves_held_in_some_components(components, integrator, friction):
    held = [nts.Dirichlet(lambda x: x[2] < 0.001 + 1e-9, components=components)]
    system = scene(gap=0.001, cube=held, plate_velocity=(0.1, 0.0, 1.0), friction=friction)
    table = run(system, integrator)
    assert table["active"].max() == 4


def test_held_slaves_driven_against_a_held_master_have_nothing_to_solve(integrator):
    """Both sides prescribed: no pair, hence no constraint that could contradict them."""
    moving = [nts.Dirichlet(everywhere, lambda t: (0.0, 0.0, -0.5 * t))]
    system = scene(gap=0.01, cube=moving, plate=[nts.Dirichlet(everywhere)])
    table = run(system, integrator)
    assert table["active"].max() == 0
    assert np.isinf(table["min_gap"]).all()


@rubbing
@pytest.mark.fast_on_ranks("midpoint-0.3")
def test_one_facet_and_one_slave_cell(integrator, friction):
    """One cell each: every further rank owns neither facet nor slave."""
    system = scene(gap=0.002, velocity=(0.0, 0.0, -1.0), cells=1, friction=friction)
    owned = np.array(COMM.allgather([len(c.slave.rows) for c in system.contacts]))
    assert owned.sum() == 4
    assert COMM.size == 1 or owned.min() == 0
    table = run(system, integrator)
    assert table["active"].max() == 4


@pytest.mark.parametrize("condense", [False, True])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("True")
def test_krylov_with_ranks_that_own_nothing(condense):
    newton = nts.Newton(linear_solver="krylov", condense=condense)
    tables = {}
    for name, comm in (("all", COMM), ("one", MPI.COMM_SELF)):
        low, high = (
            create_box(comm, corners, [1, 1, 1], CellType.hexahedron)
            for corners in ([[0, 0, -1], [1, 1, 0]], [[0.1, 0.1, 0.01], [0.9, 0.9, 0.9]])
        )
        base = nts.Continuum(low, RUBBER, density=1e4, name="base")
        cube = nts.Continuum(high, RUBBER, density=1e4, velocity=(0.5, 0.2, -2), name="cube")
        slave = cube.surface(lambda x: x[2] < 0.01 + 1e-9)
        pair = nts.ContactPair(slave, base.surface(lambda x: x[2] > -1e-9), friction=0.3)
        run = nts.simulate(
            nts.System([base, cube], contacts=[pair]), nts.EnergyMomentum(),
            dt=2e-3, t_end=0.03, newton=newton,
        )  # fmt: skip
        assert run.status == "completed" and run.balance["active"].max() == 4
        tables[name] = run.balance["energy"]
    assert np.abs(tables["all"] / tables["one"] - 1).max() < 1e-10


def test_contact_is_divided_evenly_however_the_mesh_is():
    """Every point once, each part of a surface about evenly, and back to where coordinates are."""
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [16, 16, 2], CellType.hexahedron)
    body = nts.Continuum(mesh, nts.NeoHookean(1e6, 0.3), density=1e3)
    surface = body.surface(lambda x: x[2] > 1 - 1e-9)
    shares = COMM.allgather(surface.share)
    assert np.array_equal(np.sort(np.concatenate(shares)), np.arange(17**2))
    x = surface.reference
    for part in (x[:, 0] < 2, x[:, 0] < 0.4, x[:, 1] > 0.7, np.hypot(*x[:, :2].T) < 0.5):
        count = np.array([np.count_nonzero(part[share]) for share in shares])
        assert np.abs(count * COMM.size / part.sum() - 1).max() < 0.5
    own = body.reference.reshape(-1, 3)[surface.rows]
    assert np.allclose(surface.at_own(x[surface.share]), own, rtol=0, atol=1e-14)


def test_more_ranks_than_cells(on_ranks):
    name = f"{__file__}::test_one_facet_and_one_slave_cell"
    on_ranks(3, "-m", "pytest", "-q", "-p", "no:cacheprovider", name)


@pytest.mark.parametrize("friction", [0.0, 0.3, np.inf])
@pytest.mark.fast("energy-momentum-0.0")
@pytest.mark.fast_on_ranks()
def test_the_same_gap_closed_twice_is_refused_or_as_closed_once(friction, integrator):
    """Twice the same pair is an error; two fixed plates in one plane are that plane."""
    whole = [nts.Dirichlet(lambda x: x[2] < 9)]
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)

    def box(low, high, cells, name, **options):
        mesh = create_box(COMM, [low, high], cells, CellType.hexahedron)
        return nts.Continuum(mesh, rubber, density=1e3, name=name, **options)

    def falls(masters, *bodies):
        pairs = [nts.ContactPair(bottom, master, friction=friction) for master in masters]
        system = nts.System([cube, *bodies], contacts=pairs)
        run = nts.simulate(system, integrator, dt=5e-3, t_end=0.06)
        assert run.status == "completed" and run.retries == 0
        return run.balance

    cube = box([0, 0, 0.05], [1, 1, 1.05], [2, 2, 2], "cube", velocity=(0, 0, -2))
    plates = [
        box([k - 0.5, -0.2, -0.5], [k + 0.5, 1.2, 0], [1, 1, 1], f"plate{k}", bcs=whole)
        for k in (0, 1)
    ]
    bottom = cube.surface(lambda x: x[2] < 0.05 + 1e-9)
    tops = [p.surface(lambda x: x[2] > -1e-9) for p in plates]
    pair = nts.ContactPair(bottom, tops[0])
    with pytest.raises(
        ValueError, match=r"same nodes of 'cube'.*same facets of 'plate0'; drop one"
    ):
        nts.System([cube, *plates], contacts=[pair, pair])
    once, twice = falls([nts.Plane((0, 0, 0), (0, 0, 1))]), falls(tops, *plates)
    assert once["active"].max() == 9
    for name in ("energy", "contact_defect", "friction_dissipation", "linear_momentum"):
        scale = np.abs(once["energy" if name != "linear_momentum" else name]).max()
        assert np.abs(once[name] - twice[name]).max() < 1e-9 * scale


@pytest.mark.slow
@pytest.mark.parametrize("by", ["plane", "support"])
def test_nodes_between_two_that_do_not_yield_are_named(by, integrator):
    """Driven at 1 m/s at a plane that is 1 cm away they have nowhere to go from 0.01 s on."""
    mesh = create_box(COMM, [[0, 0, 0.01], [1, 1, 1.01]], [1, 1, 1], CellType.hexahedron)
    low, above = (
        (lambda x: x[2] < 0.02),
        nts.Plane((0, 0, 0.02), (0, 0, -1), motion=lambda t: (0.0, 0.0, -t), name="above"),
    )
    held = nts.Dirichlet(low, components=(2,), value=lambda t: (0.0, 0.0, -t))
    bcs = [held] if by == "support" else []
    cube = nts.Continuum(mesh, RUBBER, density=1e3, name="cube", bcs=bcs)
    floor, bottom = nts.Plane((0, 0, 0), (0, 0, 1), name="floor"), cube.surface(low)
    pairs = [nts.ContactPair(bottom, p) for p in ([floor, above] if by == "plane" else [floor])]
    run = nts.simulate(
        nts.System([cube], contacts=pairs), integrator, dt=2e-3, t_end=0.04,
        newton=nts.Newton(max_retries=1),
    )  # fmt: skip
    end = 0.02 if by == "plane" else 0.01
    assert end - 2e-3 <= run.balance["time"][-1] <= end + 1e-9
    both = "'cube-floor' and 'cube-above'" if by == "plane" else "'cube-floor' and a support"
    assert f"{both} may hold the same nodes" in run.status


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "row", "states"),
    [(0.0, 0, "contact and none"), (0.3, 0, "contact and none"), (0.3, 1, "stick and slip")],
)
def test_nodes_that_flip_are_named_with_their_states(friction, row, states, integrator):
    """Seven flips in a step are said to be some, eight to be a cycle, of whatever kinds they are.

    What may end the cycle is said, too.
    """
    stepper = nts.Stepper(scene(velocity=(0.0, 0.0, -1.0), friction=friction), integrator)
    stepper.start(2e-3)
    stepper.problem.begin(stepper.state, 2e-3)
    step, (contact,) = stepper.solver.solve(), stepper.problem.elements
    flips = np.zeros((2, contact.num_elements), dtype=int)
    for count in (7, 8):
        flips[row] = count
        if contact.num_elements:
            text = contact.describe(step.parts[0], flips)[1]
            assert text.startswith("contact 'cube-plate': node ")
            assert (f"flips between {states} and settles in neither" in text) == (count == 8)
            assert text.endswith("settles in neither; try steps of another length") == (count == 8)
            beyond = np.full_like(step.parts[0].residual, np.inf)
            with np.errstate(over="raise"):
                assert contact.describe(step.parts[0]._replace(residual=beyond), flips)[0] == np.inf
    if contact.num_elements:
        flips[:] = 4
        assert "settles in neither" in contact.describe(step.parts[0], flips)[1]
    stepper.close()


@pytest.mark.parametrize("told", [True, False])
def test_a_failure_advises_only_where_its_text_does(told):
    """Of the nodes that flip, the one that is worst solved is named, with or without a remedy."""
    if COMM.size > 1:
        pytest.skip("nodes 0 and 1 are of one rank")
    stepper = nts.Stepper(scene(velocity=(0.0, 0.0, -1.0)), nts.EnergyMomentum())
    stepper.start(2e-3)
    stepper.problem.begin(stepper.state, 2e-3)
    solver = stepper.solver
    step = solver.solve()
    solver.iterates.flips[0][0, 0] = 8
    step.parts[0].residual[0 if told else 1, -1] = 1e3
    failure = solver._failure(step, PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT, 9)
    remedy = "settles in neither; try steps of another length"
    assert failure.advises == told == (remedy in str(failure))
    stepper.close()


@rubbing
@pytest.mark.fast_on_ranks()
def test_contacts_that_change_one_at_a_time_end_in_the_same_step(friction, monkeypatch):
    """What a second attempt does where the whole active set goes to and fro."""
    ends, imposed = [], []
    for alone in (False, True):
        stepper = nts.Stepper(
            scene("across", velocity=(0.3, 0.0, -1.0), friction=friction), nts.EnergyMomentum()
        )
        solver, contacts = stepper.solver, stepper.problem.couplings.contacts
        if alone:
            restart, impose = solver.iterates.restart, contacts.imposed

            def pivoting(solver=solver, restart=restart):
                restart()
                solver.iterates.try_again(pivots=True)

            def counted(active, impose=impose):
                imposed.append(active)
                return impose(active)

            monkeypatch.setattr(iterates, "_PATIENCE", 0)
            monkeypatch.setattr(solver.iterates, "restart", pivoting)
            monkeypatch.setattr(contacts, "imposed", counted)
        for _ in range(8):
            state = stepper.advance(2e-3)
        assert stepper.solution.balance["active"].max() > 1
        ends.append(np.concatenate(state.u))
        stepper.close()
    assert imposed
    assert np.abs(ends[0] - ends[1]).max(initial=0.0) < ROUND_OFF


@pytest.mark.parametrize("side", [0.1, 5.0])
def test_a_fast_soft_cube_on_a_coarse_rigid_plate(side):
    """It moves by a quarter of a cell in a step; the size of the plate's one facet matters not."""
    mesh = create_box(
        COMM, [[0, 0, 0.003], [0.1, 0.1, 0.103]], [2] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    cube = nts.Continuum(mesh, RUBBER, density=1e3, velocity=(0, 0, -20.0), name="cube")
    low, high = [0.05 - side, 0.05 - side, -side], [0.05 + side, 0.05 + side, 0.0]
    plate = nts.RigidBody(
        create_box(COMM, [low, high], [1] * 3, CellType.hexahedron), density=1e3,
        motion=lambda t: (0.0, 0.0, 0.0), rotation=(0, 0, 0), name="plate",
    )  # fmt: skip
    pair = nts.ContactPair(
        cube.surface(lambda x: x[2] < 0.003 + 1e-9), plate.surface(lambda x: x[2] > -1e-9)
    )
    stepper = nts.Stepper(nts.System([cube, plate], contacts=[pair]), nts.EnergyMomentum())
    stepper.start(6e-4)
    stepper.problem.begin(stepper.state, 6e-4)
    assert stepper.problem.dives
    stepper.problem.guess(flight=False, forces=True)
    first = stepper.problem.x.array_r.copy()
    stepper.problem.first_guess()
    assert np.array_equal(stepper.problem.x.array_r, first)
    stepper.close()


def test_a_solution_that_misses_contacts_is_gone_on_from():
    """Its positions, and its forces by node; what is new carries nothing yet."""
    system = scene("across", velocity=(0.0, 0.0, -1.0))
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    for _ in range(2):
        stepper.advance(2e-3)
    problem = stepper.problem
    problem.begin(stepper.state, 2e-3)
    solved = stepper.solver.solve()
    problem.begin(stepper.state, 2e-3, solved)
    again = problem.evaluate(problem.x)
    for a, b in zip(again.bodies, solved.bodies, strict=True):
        assert np.abs(a.u1 - b.u1).max(initial=0.0) == 0.0
    for a, b in zip(again.parts, solved.parts, strict=True):
        scale = max(1e-30, float(np.abs(b.multiplier).max(initial=0.0)))
        assert np.abs(a.multiplier[:, 0] - b.multiplier[:, 0]).max(initial=0.0) < 1e-12 * scale
        assert np.array_equal(a.active, b.active)
    stepper.close()


class Breaks:
    """A solver whose solves end by an error of PETSc."""

    def __init__(self, snes):
        self._snes = snes

    def __getattr__(self, name):
        return getattr(self._snes, name)

    def solve(self, *_):
        raise PETSc.Error(76)


@pytest.mark.slow
def test_an_error_of_petsc_is_told_with_its_likely_cause(integrator, monkeypatch):
    """As that of a factorisation of constraints of which one repeats another."""
    newton = nts.Newton(linear_solver="direct", max_retries=0)
    stepper = nts.Stepper(scene(velocity=(0.0, 0.0, -1.0)), integrator, newton=newton)
    stepper.start(2e-3)
    prepare = type(stepper.solver).prepare

    def breaking(self):
        prepare(self)
        if not isinstance(self.snes, Breaks):
            self.snes = Breaks(self.snes)

    monkeypatch.setattr(type(stepper.solver), "prepare", breaking)
    words = "PETSc stopped with error 76; two contacts, or a contact and a support, may hold the"
    with pytest.raises(nts.StepFailedError, match=words):
        stepper.advance(2e-3)
    stepper.close()


def test_an_error_of_petsc_is_not_told_as_an_earlier_one():
    """What a residual raised in a step that was given up is none of a later solve's."""
    body = nts.RigidBody.from_inertia(1.0, (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    newton = nts.Newton(linear_solver="direct", max_retries=0)
    stepper = nts.Stepper(nts.System([body]), nts.EnergyMomentum(), newton=newton)
    stepper.start(1e-2)
    evaluate, solver = stepper.problem.evaluate, stepper.solver

    def raising(*_):
        raise nts.StepFailedError("an early failure")

    stepper.problem.begin(stepper.state, 1e-2)
    solver.prepare()
    stepper.problem.evaluate = raising
    solver.iterates.try_again(pivots=True)
    with pytest.raises(nts.StepFailedError, match="an early failure"):
        solver._function(None, stepper.problem.x, None)
    stepper.problem.evaluate, prepare = evaluate, solver.prepare

    def breaking():
        prepare()
        solver.snes = Breaks(solver.snes)

    solver.prepare = breaking
    with pytest.raises(nts.StepFailedError, match="PETSc stopped with error 76"):
        stepper.advance(1e-2)
    stepper.close()
