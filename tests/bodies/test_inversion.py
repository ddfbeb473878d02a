"""Cells inside out: det F in closed form, steps refused, cut back, or allowed and told."""

import re

from mpi4py import MPI

import numpy as np
import pytest
import two_blocks
from dolfinx.mesh import CellType
from measures import OPEN, PROMISED, ledger_or_word
from point_mass import PointMass
from scenes import RUBBER, box, green, saint_venant

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.inversion import smallest_dets
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.output import BalanceCSV
from dolfinx_nts.solve.accuracy import ACCURACY
from dolfinx_nts.solve.inversion_guard import InversionGuard

COMM = MPI.COMM_WORLD
SENTENCE = "inside out, which W(C) cannot see: det F = "


def cube(n=2, size=(1.0, 1.0, 1.0), comm=COMM, cell=CellType.hexahedron, **options):
    mesh = box([0, 0, 0], size, n, cell, comm=comm)
    return nts.Continuum(mesh, RUBBER, density=1e3, **({"name": "cube"} | options))


def form_cube(n=2, **options):
    """A cube of forms of a user's own."""
    mesh = box(cells=n)
    space = compat.vector_space(mesh, 1)
    return nts.FormBody(
        space, saint_venant(2e5, 0.3), strain=green, density=1e3, name="cube", **options
    )


def displace(body, motion):
    """Displacement that takes the body's coordinates X, shape (n, 3), to motion(X)."""
    x = body.reference.reshape(-1, 3)
    return (motion(x) - x).ravel()


def corner_dets(body):
    """Smallest det F at the corners of all hexahedra at the accepted u, by triple products."""
    x = body.mesh.geometry.x
    cells = compat.geometry_dofmap(body.mesh)[: body.mesh.topology.index_map(3).size_local]
    u = body.u.x.array.reshape(-1, 3)
    now = (x[cells], x[cells] + u[compat.cell_dofs(body.space)[: len(cells)]])
    least = np.inf
    for corner in range(8):
        edges = [a[:, [corner ^ 1, corner ^ 2, corner ^ 4]] - a[:, [corner]] for a in now]
        before, after = (np.linalg.det(e) for e in edges)
        least = min(least, (after / before).min(initial=np.inf))
    return COMM.allreduce(least, op=MPI.MIN)


class Watch:
    """Writer that notes the smallest corner det F of the accepted states."""

    def start(self, stepper):
        self.dets = [self.of(stepper)]

    def write(self, stepper, last):
        self.dets.append(self.of(stepper))

    def close(self, stepper):
        pass

    @staticmethod
    def of(stepper):
        return min(corner_dets(b) for b in stepper.system.bodies)


@pytest.fixture
def evaluations(monkeypatch):
    """List that grows by one with every evaluation of the step equations."""
    calls, original = [], StepProblem.evaluate

    def counted(self, *at):
        calls.append(self.dt)
        return original(self, *at)

    monkeypatch.setattr(StepProblem, "evaluate", counted)
    return calls


# ---- det F
@pytest.mark.parametrize("part", [0.9, 0.7, 0.5, -1.0])
def test_a_corner_pushed_in(part):
    """Its edges are (t, t - 1, t - 1) and so on: det F is 3 t - 2 there and more elsewhere."""
    size = (2.0, 1.0, 0.5)
    body = cube(1, size, MPI.COMM_SELF)
    far = np.array(size)

    def push(x):
        return np.where(np.isclose(x, far).all(axis=1)[:, None], part * far, x)

    det, place = body.smallest_det(displace(body, push))
    # Coordinates that DOLFINx interpolates are rounded (0.9): by 3 edges times 2 eps and the slope.
    assert det == pytest.approx(3 * part - 2, abs=1e-13)
    assert np.allclose(place, far / 2)


@pytest.mark.parametrize("angle", [0.5, 2.0, 3.0])
def test_a_twist_is_seen_at_quadrature_points_alone(angle):
    """Faces turned by an angle: det F is 1 at all corners and 1 - (1 - cos) / 3 at Gauss points."""
    body = cube(1, comm=MPI.COMM_SELF)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])

    def twist(x):
        return np.where(x[:, 2:] > 0.5, x @ turn.T, x)

    det, _ = body.smallest_det(displace(body, twist))
    assert det == pytest.approx(1 - (1 - cos) / 3, abs=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize("cell", [CellType.hexahedron, CellType.tetrahedron])
@pytest.mark.parametrize("degree", [1, 2])
def test_a_homogeneous_deformation(cell, degree):
    """Every cell has the determinant of the gradient, on every rank and without cells too."""
    body = cube(1, cell=cell, degree=degree)
    gradient = np.array([[1.1, 0.2, 0.0], [-0.3, 0.8, 0.1], [0.0, 0.4, -0.7]])
    u = displace(body, lambda x: x @ gradient.T)
    dets = smallest_dets(nts.System([body]), [u])
    assert dets == pytest.approx([np.linalg.det(gradient)], rel=1e-13)


def test_edge_nodes_of_degree_two():
    """u = a x (1 - x) e_x has det F = 1 + a (1 - 2 x), least at x = 1, where there are corners."""
    body = cube(2, comm=MPI.COMM_SELF, degree=2)

    def bulge(x):
        return x + 0.6 * (x[:, :1] * (1 - x[:, :1])) * np.array([1.0, 0, 0])

    det, place = body.smallest_det(displace(body, bulge))
    assert det == pytest.approx(0.4, abs=1e-13)
    assert place[0] == pytest.approx(0.75)


def test_what_is_not_finite_counts_as_inside_out():
    body = cube(2, comm=MPI.COMM_SELF)
    u = np.zeros(body.num_owned)
    u[5] = np.nan
    assert body.smallest_det(u)[0] == -np.inf


def test_bodies_without_cells_have_none():
    system = nts.System([PointMass(COMM, 1.0, np.zeros(3), np.ones(3))])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=2e-2)
    assert np.isposinf(run.balance["min_det"]).all()


# ---- steps
def squeezed(speed, n=2, make=cube, **options):
    """A cube between two faces, the upper of which goes down at a speed."""
    below = nts.Dirichlet(lambda x: x[2] < 1e-9)
    above = nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, value=lambda t: (0, 0, -speed * t))
    return nts.System([make(n, bcs=[below, above], **options)])


def spinning(rate):
    def turn(x):
        return np.array([-rate * (x[1] - 0.5), rate * (x[0] - 0.5), 0 * x[0]])

    return nts.System([cube(3, velocity=turn)])


def dropped(times_g, **options):
    body = cube(2, velocity=(0, 0, -1.0), **options)
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), nts.Plane((0, 0, 0), (0, 0, 1)))
    return nts.System([body], contacts=[pair], gravity=(0, 0, -9.81 * times_g))


SCENES = {
    "squeeze": lambda: (squeezed(10.0, 3), nts.EnergyMomentum(), 2e-3, 0.12),
    "spin": lambda: (spinning(200.0), nts.Midpoint(), 1e-3, 0.03),
    "1e6 g": lambda: (dropped(1e6), nts.EnergyMomentum(), 1e-4, 1e-3),
}


@pytest.mark.mpi
@pytest.mark.parametrize("accuracy", ["exact", "balanced"])
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.fast("1e6 g-balanced")
@pytest.mark.fast_on_ranks()
def test_no_step_ends_inside_out(name, accuracy, evaluations):
    """The run stops with a sentence, soon, and what it has accepted is not inside out."""
    system, integrator, dt, t_end = SCENES[name]()
    watch = Watch()
    run = nts.simulate(
        system, integrator, dt=dt, t_end=t_end, newton=ACCURACY[accuracy], output=[watch]
    )
    assert SENTENCE in run.status and "Continuum(..., allow_inversion=True)" in run.status
    assert min(watch.dets) > 0.0 and run.balance["min_det"].min() > 0.0
    tried = len(run.rows) - 1 + run.retries
    assert run.retries >= 8 and len(evaluations) < 15 * tried


def struck(speed):
    return two_blocks.scene(COMM, cells=(3, 2), speed=speed)


EM, MP, ADAPT = nts.EnergyMomentum(), nts.Midpoint(), nts.Adapt()
BOTH = ("exact", "balanced")
HARD = {
    "200 m/s": (lambda: struck(200.0), EM, 2e-4, 2e-3, None, BOTH),
    "200 m/s, adapt": (lambda: struck(200.0), EM, 2e-4, 2e-3, ADAPT, ("balanced",)),
    "200 m/s, midpoint": (lambda: struck(200.0), MP, 2e-4, 2e-3, None, ("balanced",)),
    "100 m/s, midpoint": (lambda: struck(100.0), MP, 2e-4, 2e-3, None, BOTH),
    "100 m/s, midpoint, adapt": (lambda: struck(100.0), MP, 2e-4, 2e-3, ADAPT, ("balanced",)),
    "1e3 g": (lambda: dropped(1e3), EM, 1e-3, 0.02, None, BOTH),
    "1e3 g, midpoint": (lambda: dropped(1e3), MP, 1e-3, 0.02, None, ("balanced",)),
    "1e4 g": (lambda: dropped(1e4), EM, 1e-4, 3e-3, None, BOTH),
    "1e4 g, midpoint": (lambda: dropped(1e4), MP, 1e-4, 3e-3, None, ("balanced",)),
}


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(("name", "accuracy"), [(name, HARD[name][-1][-1]) for name in HARD])
def test_a_hard_impact_is_whole_or_named(name, accuracy):
    """Either it completes, or the cell and the remedies stand in the status; never inside out."""
    make, integrator, dt, t_end, adapt, _ = HARD[name]
    watch = Watch()
    run = nts.simulate(
        make(), integrator, dt=dt, t_end=t_end, accuracy=accuracy, adapt=adapt, output=[watch]
    )
    assert run.balance["active"].max() > 0
    assert min(watch.dets) > 0.0 and run.balance["min_det"].min() > 0.0
    ledger_or_word(run, PROMISED[accuracy] if integrator.closes_ledger else OPEN)
    if run.status.startswith("completed"):
        assert run.balance["time"][-1] == pytest.approx(t_end, rel=1e-12)
    else:
        assert "a cell of body '" in run.status and SENTENCE in run.status
        assert " near X = (" in run.status
        assert "smaller loads or speeds may prevent it" in run.status


@pytest.mark.mpi
def test_on_request_it_goes_on_and_says_so(mpi_tmp_path):
    system = dropped(1e6, allow_inversion=True)
    watch, path = Watch(), mpi_tmp_path / "balance.csv"
    output = [watch, BalanceCSV(path)]
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=5e-4, output=output)
    assert run.status.startswith("completed, but a cell of body 'cube' turns")
    assert f"{SENTENCE}-" in run.status
    inverted = run.balance["min_det"] <= 0.0
    assert run.warnings["inversion"].count == inverted.sum() > 0
    assert run.warnings["inversion"].first == run.balance["time"][inverted][0]
    assert run.warnings["inversion"].worst == -run.balance["min_det"].min()
    assert run.balance["min_det"].min() < min(watch.dets) + 1e-12 < 0.0
    COMM.Barrier()
    text = path.read_text()
    assert ",min_det [-]," in text and f"# warning, inversion: {inverted.sum()} step" in text


@pytest.mark.mpi
@pytest.mark.parametrize("allowed", [False, True])
@pytest.mark.fast_on_ranks()
def test_statics(allowed):
    """A press beyond what the corners bear."""
    system = squeezed(0.9, 3, allow_inversion=allowed)
    run = nts.equilibrium(system, load_steps=10, newton=nts.Newton(max_retries=2))
    if allowed:
        assert run.status.startswith("completed, but ") and f"{SENTENCE}-" in run.status
        assert run.balance["min_det"][-1] < 0.0 < run.balance["min_det"][1]
        assert run.balance["min_det"][-1] < corner_dets(system.bodies[0]) + 1e-12
    else:
        assert SENTENCE in run.status
        assert run.balance["min_det"].min() > 0.0


@pytest.mark.mpi
@pytest.mark.parametrize("pressed", [True, False], ids=["by a plane", "by its own face"])
def test_contact_is_named_before_the_cell_that_it_crushes(pressed):
    """A face is pushed through the one that is held, by a contact or by its own condition."""

    def down(t):
        return 0, 0, -1.2 * t

    bcs = [nts.Dirichlet(lambda x: x[2] < 1e-9)]
    if not pressed:
        bcs.append(nts.Dirichlet(lambda x: x[2] > 1 - 1e-9, down))
    body, contacts = cube(2, bcs=bcs), []
    if pressed:
        plane = nts.Plane((0, 0, 1), (0, 0, -1), motion=down)
        contacts.append(nts.ContactPair(body.surface(lambda x: x[2] > 1 - 1e-9), plane))
    system = nts.System([body], contacts=contacts)
    run = nts.equilibrium(system, newton=nts.Newton(max_retries=0))
    cell = run.status.index("a cell of body 'cube'")
    if pressed:
        assert run.status.index("contact 'cube-plane'") < run.status.index("look there") < cell
    else:
        assert "contact '" not in run.status


@pytest.mark.mpi
def test_a_failed_step_of_sound_cells_is_not_said_to_be_nearly_inside_out(monkeypatch):
    """One update was shortened: det F of the iterate says nothing, that in full does."""
    monkeypatch.setattr("dolfinx_nts.solve.inversion_guard._SHORTENED", 1)
    body = cube(2, bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)])
    system = nts.System([body], gravity=(0, 0, -9.81e3))
    run = nts.equilibrium(system, newton=nts.Newton(max_retries=0))
    assert "1 updates in a row were shortened; in full, a cell of body 'cube' turns" in run.status
    assert "worst block 'cube'" in run.status and "nearly inside out" not in run.status
    assert "Try more load steps" in run.status


@pytest.mark.mpi
@pytest.mark.parametrize("held", [True, False], ids=["held", "on a plane"])
@pytest.mark.fast("held")
@pytest.mark.fast_on_ranks()
def test_a_load_step_that_ends_nearly_inside_out_says_so(held, monkeypatch):
    """Newton's method ends there, or the relaxations; under 1 g, nothing is near it."""
    monkeypatch.setattr("dolfinx_nts.run.load_steps._RELAXATIONS", 10)

    def load(times_g):
        if not held:
            return nts.equilibrium(
                dropped(times_g), stabilization=0.1, newton=nts.Newton(max_retries=0)
            )
        body = cube(2, bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)])
        system = nts.System([body], gravity=(0, 0, -9.81 * times_g))
        return nts.equilibrium(system, newton=nts.Newton(max_retries=0))

    run = load(1e3 if held else 1e4)
    assert ("is not at rest" in run.status) != held and SENTENCE in run.status
    assert "a cell of body 'cube' is nearly inside out" in run.status
    assert 0.0 < float(run.status.split(SENTENCE)[1].split()[0]) <= 0.1
    assert "smaller loads or speeds may prevent it" in run.status
    assert "Try more load steps" not in run.status
    named = r"contact '.*' (flips \d+ times|carries) at node \d+ and may have .*; a cell of body"
    assert bool(re.search(named, run.status)) != held and ("look there first" in run.status) != held
    mild = load(1.0)
    assert mild.status == "completed" and mild.balance["min_det"][-1] > 0.9


# ---- bodies of a user's own forms


@pytest.mark.mpi
@pytest.mark.parametrize("allowed", [False, True])
def test_own_forms_in_statics(allowed):
    """At faces that do not widen, det F is the height, as the middle of the cube halves it."""
    system = squeezed(1.5, 2, form_cube, allow_inversion=allowed)
    run = nts.equilibrium(system, load_steps=5, newton=nts.Newton(max_retries=1))
    dets = run.balance["min_det"]
    assert dets[:4] == pytest.approx([1.0, 0.7, 0.4, 0.1], abs=1e-9)
    if allowed:
        assert run.status.startswith("completed, but ") and f"{SENTENCE}-" in run.status
        assert dets[-1] < corner_dets(system.bodies[0]) + 1e-12 and dets[-1] < 0.0
    else:
        assert SENTENCE in run.status and dets.min() > 0.0


def test_own_forms_refuse_a_start_inside_out():
    def push(x):
        return np.array([-1.5 * x[0], 0 * x[1], 0 * x[2]])

    if COMM.size == 1:
        with pytest.raises(ValueError, match="inside out, det F = -0.5"):
            form_cube(displacement=push)
        with pytest.raises(TypeError, match="allow_inversion=1"):
            form_cube(allow_inversion=1)
    body = form_cube(displacement=push, allow_inversion=True)
    assert body.smallest_det(body.initial_displacement)[0] == pytest.approx(-0.5, abs=1e-13)


# ---- line search
@pytest.mark.mpi
@pytest.mark.parametrize("scale", [1e-3, 0.3, 1.0, 30.0])
def test_an_update_is_halved_until_a_tenth_of_det_is_left(scale):
    """In the first attempt at a step not at all."""
    system = nts.System([cube(2)])
    (body,) = system.bodies
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    stepper.problem.begin(stepper.state, 1e-3)
    upright = InversionGuard(stepper.problem)
    step = scale * np.cos(9 * body.reference.reshape(-1, 3)[:, [1, 2, 0]]).ravel()

    def left(part):
        body.accept(-part * step, np.zeros_like(step))
        return corner_dets(body)

    x, y = stepper.problem.x, stepper.problem.x.duplicate()
    for careful in (False, True):
        upright.begin(careful=careful)
        y.array_w[:] = step
        changed = upright.shorten(x, y)
        part = COMM.allreduce(y.array_r @ step) / COMM.allreduce(step @ step)
        assert changed == (part < 1.0) == (careful and left(1.0) < 0.1)
    # Halved as often as needed and no more; at such a smooth update corners have the smallest det.
    assert np.log2(part) == pytest.approx(round(np.log2(part)), abs=1e-12)
    assert left(part) >= 0.1 and (part == 1.0 or left(2 * part) < 0.1)
    y.destroy()
    stepper.close()


def test_the_option_is_a_bool():
    with pytest.raises(TypeError, match="allow_inversion='yes'"):
        cube(1, comm=MPI.COMM_SELF, allow_inversion="yes")
