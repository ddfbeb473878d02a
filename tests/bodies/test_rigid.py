"""Rigid bodies without contact: Euler's equations, degenerate inertia, loads, prescribed motion."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from integrators import INTEGRATORS
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts
from dolfinx_nts.output import Fields
from dolfinx_nts.output.pictures import picture

COMM = MPI.COMM_WORLD


def box(low=(0, 0, 0), size=(1, 1, 1), n=(1, 1, 1), turn=None, kind=CellType.hexahedron, **options):
    low = np.array(low, dtype=float)
    mesh = create_box(
        COMM, [low, low + np.array(size)], list(n), kind, ghost_mode=GhostMode.shared_facet
    )
    if turn is not None:
        mesh.geometry.x[:] = mesh.geometry.x @ Rotation.from_rotvec(turn).as_matrix().T
    return nts.RigidBody(mesh, density=options.pop("density", 1e3), **options)


def euler(moments, w, t):
    """Rotation matrix of a free body at a time, by SciPy."""

    def rate(_, s):
        r, w = s[:9].reshape(3, 3), s[9:]
        return np.concatenate([(r @ hat(w)).ravel(), -np.cross(w, moments * w) / moments])

    def hat(w):
        return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])

    start = np.concatenate([np.eye(3).ravel(), w])
    end = solve_ivp(rate, (0, t), start, rtol=1e-13, atol=1e-14, method="DOP853").y[:, -1]
    return end[:9].reshape(3, 3)


MOMENTS, SPIN = np.array([1.0, 2.0, 3.0]), np.array([0.01, 1.0, 0.01])


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("dt", "figure"), [(0.2, 3.796e-2), (0.1, 9.643e-3), (0.05, 2.420e-3), (0.025, 6.057e-4)]
)
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("0.2-0.03796")
def test_a_free_body_errs_as_an_independent_program_does(dt, figure):
    """Theory section 12: largest entry of the rotation at t = 10 s against Euler's equations."""
    body = nts.RigidBody.from_inertia(1.0, MOMENTS, angular_velocity=SPIN)
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=dt, t_end=10.0)
    error = np.abs(body.rotation - euler(MOMENTS, SPIN, 10.0)).max()
    table = run.balance
    assert run.status == "completed" and error == pytest.approx(figure, rel=2e-4)
    assert np.ptp(table["energy"]) < 1e-12 * table["energy"][0]
    assert np.ptp(table["angular_momentum"], axis=0).max() < 1e-12
    assert np.abs(body.rotation.T @ body.rotation - np.eye(3)).max() < 1e-13


@pytest.mark.mpi
@pytest.mark.parametrize("kind", [CellType.hexahedron, CellType.tetrahedron])
def test_mass_centre_and_inertia_of_a_box(kind):
    a, b, c = 1.0, 2.0, 0.5
    turn = np.array([0.3, -0.5, 0.2])
    body = box(size=(a, b, c), n=(2, 3, 2), turn=turn, kind=kind)
    r = Rotation.from_rotvec(turn).as_matrix()
    assert body.mass == pytest.approx(1e3 * a * b * c, rel=1e-13)
    assert np.abs(body.position - r @ (0.5 * np.array([a, b, c]))).max() < 1e-13
    exact = body.mass / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    assert np.sort(body.moments) == pytest.approx(np.sort(exact), rel=1e-12)
    assert np.linalg.det(body.rotation) == pytest.approx(1.0, rel=1e-13)
    whole = body.rotation @ np.diag(body.moments) @ body.rotation.T
    assert np.abs(whole - r @ np.diag(exact) @ r.T).max() < 1e-11 * exact.max()


@pytest.mark.mpi
def test_motion_of_a_rigid_body_is_that_of_its_coordinates():
    body = box(size=(1, 2, 0.5), velocity=(1, 2, 3), angular_velocity=(0.5, -1, 2))
    found = nts.motion_of(body)
    assert found.mass == pytest.approx(body.mass, rel=1e-13)
    for one, two in (
        (found.centre, body.position), (found.velocity, [1, 2, 3]), (found.spin, [0.5, -1, 2]),
        (body.angular_velocity, [0.5, -1, 2]),
    ):  # fmt: skip
        assert np.abs(np.array(one) - two).max() < 1e-12
    whole = body.rotation @ np.diag(body.moments) @ body.rotation.T
    assert np.abs(found.inertia - whole).max() < 1e-10


@pytest.mark.parametrize("moments", [(1, 1, 2), (1, 1, 0), (0, 0, 0)], ids=["disc", "rod", "point"])
def test_degenerate_inertia_flies_and_keeps_what_it_must(moments):
    w = (1.0, 2.0, 0.0 if moments[2] == 0 else 3.0)
    body = nts.RigidBody.from_inertia(
        2.0, moments, velocity=(1, 0, 2), angular_velocity=w, force=(0, 1, 0)
    )
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=0.05, t_end=2.0)
    table, spin = run.balance, table_spin(run)
    assert run.status == "completed"
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["energy"][0]
    assert body.velocity == pytest.approx([1, 1, 2], abs=1e-12)
    assert np.abs(body.position - [2, 1, 4]).max() < 1e-12
    assert np.ptp(spin, axis=0).max() < 1e-11 * max(1.0, np.abs(spin).max())


def table_spin(run):
    """Angular momentum about the moving centre: J - x cross p, from the table."""
    t, table = run.balance["time"], run.balance
    x = np.outer(t, [1, 0, 2]) + np.outer(0.25 * t**2, [0, 1, 0])
    return table["angular_momentum"] - np.cross(x, table["linear_momentum"])


@pytest.mark.parametrize("rule", ["energy-momentum", "midpoint"])
@pytest.mark.fast("energy-momentum")
def test_a_torque_turns_and_its_work_is_in_the_ledger(rule):
    errors = []
    for dt in (0.1, 0.05):
        body = nts.RigidBody.from_inertia(2.0, (1, 2, 2.5), torque=(0, 0, 1.5), force=(1, 0, 0))
        run = nts.simulate(nts.System([body]), INTEGRATORS[rule], dt=dt, t_end=2.0)
        turned = Rotation.from_rotvec([0, 0, 0.5 * 1.5 / 2.5 * 2.0**2]).as_matrix()
        errors.append(np.abs(body.rotation - turned).max())
        assert body.angular_velocity == pytest.approx([0, 0, 1.5 * 2 / 2.5], abs=1e-9)
        assert np.abs(run.balance["ledger_residual"]).max() < 1e-12 * run.balance["energy"][-1]
        assert body.velocity == pytest.approx([1, 0, 0], abs=1e-12)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("rule", ["energy-momentum", "midpoint"])
@pytest.mark.parametrize(("spin", "torque"), [(5.0, 0.06), (20.0, 60.0)])
def test_the_impulse_of_a_torque_is_exact_at_any_turn(rule, spin, torque):
    """Half a radian and two radians a step."""
    body = nts.RigidBody.from_inertia(
        2.0, (1, 2, 3), angular_velocity=(0, 0, spin), torque=(0, 0, torque)
    )
    run = nts.simulate(nts.System([body]), INTEGRATORS[rule], dt=0.1, t_end=1.0)
    change = run.balance["angular_momentum"][-1] - run.balance["angular_momentum"][0]
    assert change == pytest.approx([0, 0, torque], rel=1e-9, abs=1e-9)


def spinning(spin):
    """A top beside a body that stands still; of a symmetric one steps turn by 2 arctan(h w / 2)."""
    top = nts.RigidBody.from_inertia(1.0, (1, 1, 1), angular_velocity=(0, 0, spin), name="top")
    return nts.System([nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="still"), top])


def circling(spin):
    """A mass at the end of a rod, without a spin; its chords are h w by a radius of 1."""
    mass = nts.RigidBody.from_inertia(1.0, (0, 0, 0), centre=(1, 0, 0), velocity=(0, spin, 0))
    rod = nts.Distance(None, mass, points=((0, 0, 0), (1, 0, 0)), name="rod")
    return nts.System([mass], joints=[rod])


@pytest.mark.mpi
@pytest.mark.parametrize(("spin", "told"), [(9.0, False), (12.0, True)])
@pytest.mark.parametrize(("scene", "name"), [(spinning, "body 'top'"), (circling, "joint 'rod'")])
def test_a_turn_of_a_radian_in_a_step_is_told(scene, name, spin, told):
    run = nts.simulate(scene(spin), nts.EnergyMomentum(), dt=0.1, t_end=0.5)
    assert run.status == "completed" and ("turns" in run.warnings) is told
    if told:
        found = run.warnings["turns"]
        assert found.worst == pytest.approx(2 * np.arctan(0.05 * spin), rel=1e-9)
        assert found.count == 5 and f"{name} turns by 1.1 rad in a step" in found.text


@pytest.mark.mpi
def test_a_rod_that_swings_in_a_load_step_has_no_turn_to_tell():
    """A spring draws the mass at its end round by 1.2 rad."""
    start = (np.sin(1.2), 0.0, -np.cos(1.2))
    mass = nts.RigidBody.from_inertia(1.0, (0, 0, 0), centre=start)
    rod = nts.Distance(None, mass, points=((0, 0, 0), start))
    spring = nts.Spring(None, mass, ((0, 0, -4), start), stiffness=100.0, length=1.0)
    run = nts.equilibrium(nts.System([mass], joints=[rod, spring]))
    assert mass.position == pytest.approx([0, 0, -1], abs=1e-9)
    assert "turns" not in run.warnings


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("given", "turn"),
    [("vector", 0.9), ("matrix", 1.1), ("vector", 5.5), ("matrix", 2 * np.pi), ("vector", 7.0),
     ("matrix", 10 * np.pi)],
)  # fmt: skip
def test_a_prescribed_turn_counts_whole_turns(turn, given):
    """The places at both ends of a step do not tell them: the energy of 12 rad a step was 67 J."""

    def rotation(t):
        vector = np.array([0.0, 0.0, turn / 0.05 * t])
        return vector if given == "vector" else Rotation.from_rotvec(vector).as_matrix()

    wheel = nts.RigidBody.from_inertia(
        1.0, (1, 1, 1), motion=(0, 0, 0), rotation=rotation, name="wheel"
    )
    run = nts.simulate(nts.System([wheel]), nts.EnergyMomentum(), dt=0.05, t_end=0.1)
    assert ("turns" in run.warnings) is (turn > 1.0)
    if turn < 1.0:
        assert run.status == "completed"
    else:
        assert run.status.startswith("completed, but body 'wheel' turns")
        assert run.warnings["turns"].count == 2
        assert "body 'wheel' turns by" in run.warnings["turns"].text
    if turn < np.pi:
        assert wheel.prescribed_turn(0.0, 0.05) == pytest.approx(turn, rel=1e-12)


def test_tangent_of_a_torque_is_its_derivative():
    body = nts.RigidBody.from_inertia(2.0, (1, 2, 2.5), torque=(0.3, -0.5, 1.5), motion=(0, 0, 0))
    rng = np.random.default_rng(1)
    u0, u1, du = 0.3 * rng.standard_normal((3, 12))
    body.begin_step(nts.EnergyMomentum(), nts.EvaluationPoint(u0, 0.0))
    step, none = 1e-6, np.zeros(3)
    change = body.external(u1 + step * du, none) - body.external(u1 - step * du, none)
    rows, _, values = body.tangent(u1, 0.0, 1.0).getValuesCSR()
    tangent = values.reshape(12, 12)
    expected = -change / (2.0 * step)
    assert (np.diff(rows) == 12).all()
    du[:3] = 0.0
    assert (tangent @ du)[3:] == pytest.approx(expected[3:], rel=1e-7, abs=1e-9)


def test_reactions_of_prescribed_motion_are_force_and_moment():
    """A clamp carries weight and torque; a turn at constant rate of spin needs J alpha."""
    clamped = nts.RigidBody.from_inertia(
        2.0, (1, 1, 2), motion=(0, 0, 0), rotation=(0, 0, 0), torque=(0, 3, 0), name="clamped"
    )
    turned = nts.RigidBody.from_inertia(
        1.0, (1, 1, 2), rotation=lambda t: (0, 0, t * t), name="turned"
    )
    run = nts.simulate(
        nts.System([clamped, turned], gravity=(0, 0, -10)), nts.EnergyMomentum(), dt=0.02, t_end=0.4
    )
    assert run.reactions["clamped"][-1] == pytest.approx(np.array([[0, 0, 20], [0, -3, 0]]))
    assert run.reactions["turned"][-1, 0] == pytest.approx([0, 0, 4], rel=1e-3, abs=1e-9)


def test_reactions_depend_on_the_displacement_that_is_asked_for():
    """Not on the iterate that was evaluated last."""
    body = nts.RigidBody.from_inertia(2.0, (1, 1, 2), rotation=(0, 0, 0))
    force, u1, other = 0.3 * np.random.default_rng(2).standard_normal((3, 12))
    body.begin_step(nts.EnergyMomentum(), nts.EvaluationPoint(np.zeros(12), 0.0))
    arms = (body.reference + 0.5 * u1).reshape(4, 3)[1:]
    moment = np.cross(arms, force.reshape(4, 3)[1:]).sum(axis=0)
    body.external(other, np.zeros(3))
    assert body.reactions(force, u1) == pytest.approx(moment[None], rel=1e-14)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_prescribed_motion_does_external_work():
    """The body follows; the work is that of the forces that accelerate it."""
    body = nts.RigidBody.from_inertia(
        2.0, (1, 2, 2.5), motion=lambda t: (0.5 * t**2, 0, 0),
        rotation=lambda t: (0, 0, 0.25 * t**2),
    )  # fmt: skip
    run = nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=0.01, t_end=2.0)
    table = run.balance
    assert run.status == "completed" and body.position[0] == pytest.approx(2.0, rel=1e-12)
    turned = Rotation.from_rotvec([0, 0, 1.0]).as_matrix()
    assert np.abs(body.rotation - turned).max() < 1e-12
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * table["energy"][-1]
    exact = 0.5 * 2.0 * 2.0**2 + 0.5 * 2.5 * 1.0**2
    assert table["energy"][-1] == pytest.approx(exact, rel=1e-3)
    assert run.reactions["rigid"][-1, 0, 0] == pytest.approx(2.0, rel=1e-8)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_fields_and_pictures_show_the_mesh(mpi_tmp_path):
    import h5py

    body = box(n=(2, 2, 2), angular_velocity=(0, 0, np.pi), name="spinning")
    bare, start = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="bare"), body.rotation
    run = nts.simulate(
        nts.System([body, bare]), nts.EnergyMomentum(), dt=0.05, t_end=0.5,
        output=[Fields(mpi_tmp_path)],
    )  # fmt: skip
    picture([body], mpi_tmp_path / "spinning.png")
    assert run.status == "completed"
    if COMM.rank == 0:
        with h5py.File(mpi_tmp_path / "spinning.h5") as file:
            x, u = file["mesh/points"][:], file["000010/displacement"][:]
        turned = (x - 0.5) @ (body.rotation @ start.T).T + 0.5
        assert np.abs(x + u - turned).max() < 1e-12
        assert not (mpi_tmp_path / "bare.h5").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mass": 0.0}, "mass=0.0"),
        ({"mass": np.nan}, "mass=nan"),
        ({"inertia": (1, 1)}, "inertia=(1, 1)"),
        ({"inertia": (-1, 1, 1)}, "negative"),
        ({"inertia": (1, 1, 3)}, "exceeds the sum of the others"),
        ({"inertia": [[1, 1, 0], [0, 1, 0], [0, 0, 1]]}, "not symmetric"),
        ({"axes": np.diag([1, 1, -1.0])}, "left-handed"),
        ({"axes": np.diag([1, 1, 2.0])}, "orthonormal"),
        ({"inertia": np.eye(3), "axes": np.eye(3)}, "leave axes out"),
        ({"centre": (0, 0)}, "centre=(0, 0)"),
        ({"velocity": (0, np.inf, 0)}, "velocity="),
        ({"angular_velocity": 3.0}, "angular_velocity=3.0"),
        ({"force": (1, 2)}, "force of 'rigid'=(1, 2)"),
        ({"torque": "much"}, "torque of 'rigid'='much'"),
        ({"rotation": (1, 2)}, "rotation of 'rigid'=(1, 2)"),
        ({"rotation": np.diag([1, 1, -1.0])}, "left-handed"),
        (
            {"motion": (0, 0, 0), "velocity": (1, 0, 0)},
            "velocity of 'rigid'=[1.0, 0.0, 0.0]: motion= prescribes it; leave velocity out",
        ),
        (
            {"rotation": lambda t: (0, 0, t), "angular_velocity": (0, 0, 1)},
            "angular_velocity of 'rigid'=[0.0, 0.0, 1.0]: rotation= prescribes it",
        ),
        ({"motion": lambda t: (1, 2)}, "motion of 'rigid' at t=0.0: returned (1, 2)"),
        ({"name": ""}, "name=''"),
        ({"comm": 3}, "comm=3: pass an MPI communicator"),
        ({"comm": None}, "comm=None: pass an MPI communicator"),
    ],
)
@pytest.mark.mpi
@pytest.mark.fast_on_ranks("options0-mass=0.0")
def test_bad_input_is_told(options, words):
    given = {"mass": 1.0, "inertia": (1, 1, 1)} | options
    with pytest.raises((TypeError, ValueError)) as told:  # noqa: PT011 the words are tested
        nts.RigidBody.from_inertia(**given)
    assert words in str(told.value)


@pytest.mark.mpi
@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.parametrize(
    "options",
    [
        {"mass": 1.0 + 1e-15 * COMM.rank}, {"mass": (1.0, -1.0)[COMM.rank > 0]},
        {"inertia": (1, 1, 1 + 0.1 * COMM.rank)}, {"name": f"rigid{COMM.rank}"},
        {"motion": None if COMM.rank else (0, 0, 0)}, {"velocity": (COMM.rank, 0, 0)},
    ],
    ids=lambda options: next(iter(options)),
)  # fmt: skip
def test_values_that_differ_between_ranks_are_refused(options):
    given = {"mass": 1.0, "inertia": (1, 1, 1)} | options
    with pytest.raises(ValueError, match=f"{next(iter(options))}: is .* on rank 1 and .*rank 0"):
        nts.RigidBody.from_inertia(**given)


def test_a_body_without_a_mesh_has_no_surface():
    body = nts.RigidBody.from_inertia(1.0, (1, 1, 1))
    with pytest.raises(ValueError, match="has no mesh"):
        body.surface(lambda x: x[0] > 0)
    with pytest.raises(TypeError, match="colour=1: unknown option"):
        nts.RigidBody.from_inertia(1.0, (1, 1, 1), colour=1)
