"""The Jacobian of a step against differences of its residual, and the convergence it gives."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType
from integrators import GRADIENTS, MID_STEP
from measures import STENCIL, block_errors, dense, relative
from pairs import pairs
from scenes import box, rotated_state, smooth_motion

import dolfinx_nts as nts
from dolfinx_nts.integrators import Static

COMM = MPI.COMM_WORLD
CELLS = {
    **{"hex": CellType.hexahedron, "tet": CellType.tetrahedron},
    **{"smooth": CellType.hexahedron, "curved": CellType.tetrahedron},
}
#: Those whose master is smooth.
SMOOTH = "smooth", "curved"
RULES = MID_STEP | GRADIENTS | {"condensed": MID_STEP["energy-momentum"]}
#: The static rule, with a stabilization, shares the equations but not the steps.
EQUATIONS = RULES | {"static": Static()}
FRICTION = {
    "none": 0.0, "slip": 0.02, "mixed": 0.4, "stick": np.inf,
    "varies": lambda v, p: 0.02 * (1.0 + 0.3 * v) / (1.0 + p / 1e3),
}  # fmt: skip
#: Cell, friction and active set of the scenes whose whole Jacobian is tested; of all others and by
#: other rules, directions are.
SCENES = [
    ("hex", "none", "mixed"), ("hex", "slip", "all"), ("hex", "stick", "all"),
    ("tet", "mixed", "mixed"), ("tet", "varies", "all"),
]  # fmt: skip


def two_blocks(
    cell, gap=0.0, speed=0.0, bcs=(), friction=0.0, integration="nodes", *, rigid=False
):  # fmt: skip
    """A small block above a larger one, which may be rigid; its lower face is the slave.

    The other's upper face may be smooth.
    """
    rubber = nts.NeoHookean(1e3, 0.3)
    upper = nts.Continuum(
        box([0.07, 0.12, 1 + gap], [0.87, 0.92, 1.8 + gap], 2, CELLS[cell]),
        rubber,
        density=1.0,
        degree=1,
        velocity=(0, 0, -speed),
        name="upper",
    )
    mesh = box([0, 0, 0], [1, 1, 1], 2, CELLS[cell])
    lower = (
        nts.RigidBody(mesh, density=1.5, name="lower") if rigid
        else nts.Continuum(mesh, rubber, density=1.5, degree=1, name="lower", bcs=bcs)
    )  # fmt: skip
    pair = nts.ContactPair(
        slave=upper.surface(lambda x: x[2] < 1 + gap + 1e-9),
        master=lower.surface(lambda x: x[2] > 1 - 1e-9, smoothing=cell in SMOOTH),
        friction=friction,
        integration=integration,
        edges=False,
    )
    return nts.System([upper, lower], contacts=[pair])


def stepper_of(system, rule):
    return nts.Stepper(system, EQUATIONS[rule], newton=nts.Newton(condense=rule == "condensed"))


class Linearised:
    """A step problem at an iterate away from its solution."""

    def __init__(self, system, rule, active, state, dt=0.02):
        self.stepper = stepper_of(system, rule)
        self.problem = problem = self.stepper.problem
        problem.stabilization.share = 0.2 if rule == "static" else 0.0
        problem.begin(state, dt)
        self.solver = self.stepper.solver
        rng = np.random.default_rng(COMM.rank)
        layout = problem.laid.layout
        fields = range(len(system.bodies), layout.counts.shape[1])
        with problem.x as x:
            for k, body in enumerate(system.bodies):
                here = layout.owned(k)
                push = smooth_motion(body.reference.reshape(-1, 3), 0.02, 5.0 + k).ravel()
                push[body.fixed] = 0.0
                x[here] += push
            if len(fields) == 2:
                here = layout.owned(fields[0])
                x[here] += 0.03 * rng.uniform(-1, 1, here.stop - here.start)
        contact = problem.elements[0]
        gap = problem.evaluate(problem.x).parts[0].gap
        on = {
            "none": np.zeros(len(gap), bool),
            "all": np.ones(len(gap), bool),
            "mixed": rng.uniform(size=len(gap)) < 0.5,
        }[active]
        margin = np.where(on, -1, 1) * rng.uniform(0.2, 0.4, len(gap))
        force = 0.05 * rng.uniform(-1, 1, (len(gap), contact.law.num_constraints))
        force[:, 0] = margin - gap
        # Constraints of rigid bodies come after those of contacts.
        here = layout.owned(fields[-1])
        with problem.x as x:
            x[here][: force.size] = force.ravel()
        evaluation = problem.evaluate(problem.x)
        assert np.array_equal(evaluation.parts[0].active, on)
        self.candidates, self.active, self.forces = len(gap), on, force.size
        self.stick = evaluation.parts[0].stick
        self.solver.assemble(evaluation)

    def residual(self, x):
        other = self.problem.x.duplicate()
        other.array_w[:] = x
        r = self.problem.residual(self.problem.evaluate(other))
        other.destroy()
        return r

    def close(self):
        self.stepper.close()

    def blocks(self):
        fields = range(self.problem.laid.layout.counts.shape[1])
        return [self.problem.laid.layout.owned(f) for f in fields]


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
@pytest.mark.parametrize(("cell", "friction", "active"), SCENES)
@pytest.mark.parametrize("rule", ["energy-momentum", "condensed"])
@pytest.mark.fast("condensed-hex-stick-all", "condensed-tet-varies-all")
def test_jacobian_is_the_derivative_of_the_residual(rule, cell, friction, active):
    system = two_blocks(cell, friction=FRICTION[friction])
    at = Linearised(system, rule, active, rotated_state(system))
    assert at.candidates == 9
    number = {"none": 0, "slip": 0, "mixed": (1, 8), "stick": 9, "varies": 0}[friction]
    if active == "all":
        low, high = np.broadcast_to(number, 2)
        assert low <= at.stick.sum() <= high
    x, step = at.problem.x.array_r.copy(), 1e-4
    expected = np.zeros((len(x), len(x)))
    for j in range(len(x)):
        for k, weight in STENCIL:
            other = x.copy()
            other[j] += k * step
            expected[:, j] += weight / step * at.residual(other)
    errors = block_errors(dense(at.solver.matrix.operator), expected, at.blocks())
    at.close()
    assert max(errors.values()) < 1e-8, errors


def along_ways(at):
    """Errors of each block of the Jacobian along some directions."""
    x, step = at.problem.x.array_r.copy(), 1e-4
    ways = np.random.default_rng(3).uniform(-0.3, 0.3, (6, len(x)))
    expected = np.zeros((len(x), len(ways)))
    for j, way in enumerate(ways):
        for k, weight in STENCIL:
            expected[:, j] += weight / step * at.residual(x + k * step * way)
    found = dense(at.solver.matrix.operator) @ ways.T
    errors = [relative(found[rows], expected[rows]) for rows in at.blocks()]
    at.close()
    return errors


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
@pytest.mark.parametrize(("rule", "cell", "friction"), [
    ("condensed", "hex", "mixed"), ("midpoint", "hex", "slip"), ("gonzalez contact", "tet", "slip"),
    ("condensed", "tet", "mixed"), ("energy-momentum", "hex", "none"), ("static", "hex", "mixed"),
])  # fmt: skip
@pytest.mark.fast("condensed-hex-mixed", "midpoint-hex-slip")
def test_jacobian_of_a_law_after_sums(rule, cell, friction):
    """Contact over the slave's surface: directions of the whole Jacobian."""
    system = two_blocks(cell, friction=FRICTION[friction], integration="surface")
    at = Linearised(system, rule, "mixed", rotated_state(system))
    assert at.candidates == 9 and 0 < at.active.sum() < 9
    errors = along_ways(at)
    assert max(errors) < 1e-8, errors


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
@pytest.mark.parametrize(("rule", "friction"), [
    ("condensed", "mixed"), ("midpoint", "slip"), ("static", "none")
])  # fmt: skip
@pytest.mark.parametrize("integration", ["nodes", "surface"])
@pytest.mark.fast("surface-condensed-mixed")
def test_jacobian_of_a_rigid_master(rule, friction, integration):
    """All but the compliance that the matrix lends contacts which may repeat each other."""
    system = two_blocks(
        "hex", speed=2.0, friction=FRICTION[friction], integration=integration, rigid=True
    )
    at = Linearised(system, rule, "mixed", system.initial_state())
    assert at.candidates == 9 and 0 < at.active.sum() < 9
    x, step = at.problem.x.array_r.copy(), 1e-4
    difference = dense(at.solver.matrix.operator)
    size = abs(difference).max(axis=1)
    for j in range(len(x)):
        for k, weight in STENCIL:
            other = x.copy()
            other[j] += k * step
            difference[:, j] -= weight / step * at.residual(other)
    contacts = at.blocks()[-1].start + np.arange(at.forces)
    lent = difference[contacts, contacts]
    difference[contacts, contacts] = 0.0
    at.close()
    assert (abs(difference).max(axis=1) < 1e-8 * size).all()
    assert (lent <= 1e-8 * size[contacts]).all() and lent.min() < 0.0


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
@pytest.mark.parametrize(("rule", "obstacle"), [
    ("condensed", nts.Plane((0, 0, 1), (0, 0, 1))), ("midpoint", nts.Plane((0, 0, 1), (0, 0, 1))),
    ("static", nts.Cylinder((0.4, 0, -2.0), (0, 1, 0), 3.0)),
], ids=["plane-condensed", "plane-midpoint", "cylinder-static"])  # fmt: skip
@pytest.mark.fast("cylinder-static")
def test_jacobian_of_obstacles_over_the_surface(rule, obstacle):
    """Tetrahedra of degree 2, nodes that stick and that slip."""
    body = nts.Continuum(
        box([0.07, 0.12, 1.01], [0.87, 0.92, 1.8], 1, CELLS["tet"]), nts.NeoHookean(1e3, 0.3),
        density=1.0, degree=2, velocity=(0.3, 0.1, -0.2),
    )  # fmt: skip
    pair = nts.ContactPair(
        body.surface(lambda x: x[2] < 1.0101), obstacle, friction=FRICTION["mixed"],
        integration="surface",
    )  # fmt: skip
    system = nts.System([body], contacts=[pair])
    at = Linearised(system, rule, "mixed", system.initial_state())
    assert at.candidates == 9 and 0 < at.active.sum() < 9
    errors = along_ways(at)
    assert max(errors) < 1e-8, errors


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
@pytest.mark.parametrize("rule", ["condensed", "static"])
@pytest.mark.fast("static")
def test_prescribed_coordinates_hold_only_a_diagonal(rule):
    bcs = [nts.Dirichlet(lambda x: x[0] > 1 - 1e-9, components=(0, 2))]
    system = two_blocks("hex", bcs=bcs)
    at = Linearised(system, rule, "mixed", rotated_state(system, 0.1, fixed=True))
    offset = at.problem.laid.layout.owned(1).start
    fixed = offset + system.bodies[1].fixed
    assert len(fixed) == 18
    matrix, x, step = dense(at.solver.matrix.operator), at.problem.x.array_r.copy(), 1e-4
    off = matrix.copy()
    off[fixed, fixed] = 0.0
    assert (matrix[fixed, fixed] > 0).all()
    assert not off[fixed].any() and not off[:, fixed].any()
    assert not at.residual(x)[fixed].any()
    free = np.setdiff1d(np.arange(len(x)), fixed)
    expected = np.zeros_like(matrix)
    for j in free:
        for k, weight in STENCIL:
            other = x.copy()
            other[j] += k * step
            expected[:, j] += weight / step * at.residual(other)
    expected[fixed, fixed] = matrix[fixed, fixed]
    errors = block_errors(matrix, expected, at.blocks())
    at.close()
    assert max(errors.values()) < 1e-8, errors


@pytest.mark.mpi
@pytest.mark.parametrize("solver", ["direct", "krylov"])
@pytest.mark.parametrize("rule", ["midpoint", "energy-momentum", "condensed"])
@pytest.mark.fast_on_ranks("energy-momentum-krylov", "condensed-direct")
def test_contact_changes_beside_matrices_that_are_kept(rule, solver):
    """Tangents exchanged in the solvers' matrix, against the matrix assembled with them."""
    system = two_blocks("hex", friction=0.4)
    newton = nts.Newton(condense=rule == "condensed", linear_solver=solver, reuse=True)
    stepper = nts.Stepper(system, RULES[rule], newton=newton)
    problem, solver = stepper.problem, stepper.solver
    problem.begin(rotated_state(system), 0.02)
    first = problem.evaluate(problem.x)
    matrix = solver.assemble(first)
    with problem.x as x:
        rng = np.random.default_rng(COMM.rank)
        x[:] += 0.01 * rng.uniform(-1, 1, len(x))
    other = problem.evaluate(problem.x)
    vectors = [problem.x.duplicate() for _ in range(3)]
    vectors[0].array_w[:] = rng.uniform(-1, 1, len(problem.x.array_r))
    solver.assemble(other)
    matrix.operator.mult(vectors[0], vectors[1])
    problem.tangents.at(first)
    matrix.assemble([part.tangent for part in other.parts])
    matrix.operator.mult(vectors[0], vectors[2])
    kept, fresh = vectors[1].array_r, vectors[2].array_r
    top = COMM.allreduce(np.abs(fresh).max(initial=0.0), op=MPI.MAX)
    np.testing.assert_allclose(kept, fresh, rtol=0, atol=1e-13 * top)
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize(("cell", "friction", "rule"), pairs(CELLS, ["none", "mixed"], EQUATIONS))
@pytest.mark.fast_on_ranks(
    "hex-none-static", "tet-mixed-static", "smooth-none-condensed", "curved-none-energy-momentum"
)
@pytest.mark.fast(
    "hex-mixed-energy-momentum", "hex-none-static", "hex-none-gonzalez contact",
    "tet-mixed-midpoint", "tet-mixed-static", "smooth-none-condensed",
    "smooth-mixed-gonzalez contact", "curved-none-energy-momentum",
    "curved-mixed-mean-value stress",
)  # fmt: skip
def test_jacobian_along_directions(cell, friction, rule):
    """As above on any number of ranks: matrix times direction."""
    system = two_blocks(cell, friction=FRICTION[friction])
    at = Linearised(system, rule, "mixed", rotated_state(system))
    assert COMM.allreduce(at.candidates) == 9
    x, step = at.problem.x.array_r.copy(), 1e-5
    rng = np.random.default_rng(100 + COMM.rank)
    direction, product = at.problem.x.duplicate(), at.problem.x.duplicate()
    for which in range(len(at.blocks())):
        p = np.zeros(len(x))
        here = at.blocks()[which]
        p[here] = rng.uniform(-1, 1, here.stop - here.start)
        direction.array_w[:] = p
        expected = sum(w / step * at.residual(x + k * step * p) for k, w in STENCIL)
        at.solver.matrix.operator.mult(direction, product)
        for rows in at.blocks():
            error = np.abs(product.array_r[rows] - expected[rows]).max(initial=0.0)
            top = COMM.allreduce(np.abs(product.array_r[rows]).max(initial=0.0), op=MPI.MAX)
            # Where nothing depends on p, the differences leave rounding errors.
            assert error <= 1e-8 * (top or 1e-2)
    direction.destroy()
    product.destroy()
    at.close()


def convergence(system, rule, state, dt):
    """Of every iterate: residual norm, unknowns, 0, 1 or 2 for off, slip, stick; least slip [m]."""
    stepper = stepper_of(system, rule)
    problem = stepper.problem
    problem.begin(state, dt)
    solver = stepper.solver
    solver.prepare()
    norms, iterates, sets = [], [], []

    def record(snes, iteration, norm):
        norms.append(norm)
        iterates.append(snes.getSolution().array_r.copy())
        sets.append([c.active.astype(int) + c.stick for c in solver.iterates.last.parts])

    solver.snes.setMonitor(record)
    (last,) = solver.solve().parts
    slips = last.distance[last.active & ~last.stick]
    stepper.close()
    return np.array(norms), iterates, sets, slips.min(initial=np.inf)


def last_change(sets):
    """The iterate from which on the sets stay as they are."""
    last = 0
    for k, (a, b) in enumerate(zip(sets[:-1], sets[1:], strict=True), start=1):
        changed = any(not np.array_equal(*pair) for pair in zip(a, b, strict=True))
        last = k if COMM.allreduce(changed, op=MPI.LOR) else last
    return last


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cell", "rule"),
    [*(("hex", rule) for rule in RULES), ("tet", "midpoint"), ("smooth", "gonzalez contact"),
     ("curved", "condensed")],
)  # fmt: skip
@pytest.mark.fast_on_ranks("smooth-gonzalez contact")
def test_newton_converges_quadratically(cell, rule):
    """A step that presses the blocks into each other: once the active set rests, r -> C r^2."""
    system = two_blocks(cell, gap=0.02, speed=6.0)
    state = rotated_state(system)
    norms, _, sets, _ = convergence(system, rule, state, 0.02)
    assert COMM.allreduce(int(sum(s.sum() for s in sets[-1]))) >= 3
    r = norms[last_change(sets) :] / norms.max()
    # Rounding of masses times positions ends the sequence a little below this.
    floor = 1e-13
    near = np.flatnonzero((r[:-1] < 0.3) & (r[:-1] > floor))
    assert len(near) >= 3
    assert (r[near + 1] < 5 * r[near] ** 2 + floor).all(), r


@pytest.mark.parametrize(
    ("cell", "rule", "states"),
    pairs(CELLS, ["midpoint", "energy-momentum", "condensed"], ["stick", "slip", "both"]),
)
@pytest.mark.fast("hex-midpoint-stick", "hex-energy-momentum-slip", "smooth-midpoint-both")
def test_newton_converges_quadratically_with_friction(cell, rule, states):
    """An oblique impact: once stick and slip rest, the distance to the solution is squared."""
    friction, changes, reached = {
        "stick": (np.inf, False, {2}), "slip": (0.02, False, {1}), "both": (0.4, True, {1, 2}),
    }[states]  # fmt: skip
    system = two_blocks(cell, gap=0.02, speed=6.0, friction=friction)
    state = system.initial_state()
    thrown = state.v[0] + np.tile([3.0, 1.2, 0.0], len(state.v[0]) // 3)
    state = replace(state, v=(thrown, state.v[1]))
    _, iterates, sets, slip = convergence(system, rule, state, 0.02)
    assert set(sets[-1][0]) == reached
    last = last_change(sets)
    assert last > 0 or not changes
    moves = np.linalg.norm(np.diff(iterates[last:], axis=0), axis=1)
    # A direction of slip turns by its error over the slip.
    near, bend = moves[:-1] < 0.1, 5.0 * max(1.0, 1.0 / slip)
    assert near.sum() >= 2 and moves[-1] < 1e-6
    assert (moves[1:] < bend * moves[:-1] ** 2)[near].all(), moves


@pytest.mark.mpi
@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("hex")
def test_condensing_changes_no_solution(cell):
    results = []
    for rule in ("energy-momentum", "condensed"):
        system = two_blocks(cell, gap=0.02, speed=6.0)
        stepper = stepper_of(system, rule)
        stepper.state = rotated_state(system)
        for _ in range(3):
            stepper.advance(0.02)
        results.append(stepper.state)
        stepper.close()
    full, condensed = results
    for name in ("u", "v", "force", "gap"):
        sides = (
            getattr(s, name) if name in "uv" else [getattr(c, name) for c in s.contacts]
            for s in (full, condensed)
        )
        for a, b in zip(*sides, strict=True):
            finite = np.isfinite(a)
            assert np.array_equal(finite, np.isfinite(b))
            top = COMM.allreduce(np.abs(a[finite]).max(initial=0.0), op=MPI.MAX)
            tolerance = 1e-10 * top if name != "gap" else 1e-12
            assert np.abs(a[finite] - b[finite]).max(initial=0.0) <= tolerance
    assert COMM.allreduce(int((full.contacts[0].force > 0).sum())) >= 3
