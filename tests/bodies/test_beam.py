"""Beams: theory sections 15, 20; benchmarks B26, B27, B29, B41."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from lines import arc, interval_mesh, straight
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts
from dolfinx_nts.kernels import beam as beam_kernel
from dolfinx_nts.kernels import quadratic as kernel

STEEL = nts.Section(EA=2000, GA=(800, 700), GJ=3, EI=(1, 2), rhoA=1, rhoI=(1e-2, 2e-2))
#: Tip of the cantilever by as many elements (B26'); Reissner's is at (.44412985, .81711894).
TIPS = {8: (0.41736301, 0.83583401), 16: (0.43863131, 0.82096875), 32: (0.44280281, 0.81800656)}
EM, MID = nts.EnergyMomentum(), nts.Midpoint()


# ---- kernel
def elements(seed=0, n=3, radius=0.3):
    """Elements with bent references, and two states of theirs."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((3, n, 8, 3))
    stiffness = np.array([3.0, 4.0, 9.0, 1.0, 2.0, 0.5])
    return beam_kernel.beams(y[0], radius, stiffness)[0], y[1], y[2]


@pytest.mark.parametrize("theta", [None, 0.5, 0.7, 1.0])
def test_the_tangent_is_the_derivative_of_the_force(theta):
    of, y0, y1 = elements()
    way = np.random.default_rng(5).standard_normal(y1.shape)
    step = 1e-6
    ahead, behind = (kernel.force(of, y0, y1 + s * way, theta) for s in (step, -step))
    found = np.einsum("nij,nj->ni", kernel.tangent(of, y0, y1, theta), way.reshape(-1, 24))
    assert found == pytest.approx((ahead - behind) / (2 * step), rel=1e-7, abs=1e-7)


def test_the_force_is_the_derivative_of_the_energy():
    of, _, y = elements(1)
    way = np.random.default_rng(6).standard_normal(y.shape)
    change = kernel.energy(of, y + 1e-6 * way) - kernel.energy(of, y - 1e-6 * way)
    work = (kernel.force(of, y, y, 1.0) * way.reshape(-1, 24)).sum(axis=1)
    assert work == pytest.approx(change / 2e-6, rel=1e-7)


def test_the_work_of_the_discrete_gradient_is_the_change_of_the_energy():
    of, y0, y1 = elements(2)
    work = (kernel.force(of, y0, y1, None) * (y1 - y0).reshape(-1, 24)).sum(axis=1)
    assert work == pytest.approx(kernel.energy(of, y1) - kernel.energy(of, y0), rel=1e-13)


def test_strains_of_known_motions():
    """Rigid motion, stretch, shear, and the bending of a straight element to an arc."""
    length, radius = 0.8, 0.3
    rest = np.zeros((1, 8, 3))
    rest[0, 4] = (0, 0, length)
    rest[0, 1:4] = rest[0, 5:] = radius * np.eye(3)
    of, _ = beam_kernel.beams(rest, radius, np.ones(6))
    turn = Rotation.from_rotvec((0.3, -1.2, 2.0)).as_matrix()
    moved = rest @ turn.T
    moved[:, ::4] += (3.0, -2.0, 1.0)
    assert np.abs(beam_kernel.strains(of, moved)).max() < 1e-14
    pulled = rest.copy()
    pulled[0, 4] += (0.01, 0.02, 0.03)
    stretch = (0.01**2 + 0.02**2 + (length + 0.03) ** 2) / length**2
    expected = (0.01 / length, 0.02 / length, 0.5 * (stretch - 1.0), 0, 0, 0)
    assert beam_kernel.strains(of, pulled)[0, 0] == pytest.approx(expected, abs=1e-15)
    for axis in range(3):
        angle, bent = 0.2, rest.copy()
        spin = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
        bent[0, 5:] = radius * spin.T
        found = beam_kernel.strains(of, bent)[0, 0]
        assert found[3 + axis] == pytest.approx(np.sin(angle) / length)


# ---- equilibrium
@pytest.mark.mpi
@pytest.mark.parametrize("n", TIPS)
@pytest.mark.fast_on_ranks("8")
def test_the_cantilever_of_reissners_equations(n):
    section = nts.Section(EA=2000, GA=(800, 800), GJ=1, EI=(1, 1), rhoA=1, rhoI=(1e-2, 1e-2))
    beam = nts.Beam(
        interval_mesh(straight(n)),
        section,
        bcs=[nts.Clamp(lambda x: x[0] < 1e-9)],
        forces=[nts.PointForce(lambda x: x[0] > 1 - 1e-9, (0, 10, 0))],
    )
    run = nts.equilibrium(nts.System([beam]), load_steps=5)
    assert run.status == "completed"
    assert beam.centreline()[1][-1] == pytest.approx((*TIPS[n], 0.0), abs=1e-8)
    assert run.reactions["beam"][-1].ravel() == pytest.approx((0, -10, 0), abs=1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("flipped", [False, True], ids=["in order", "shuffled"])
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("shuffled")
def test_the_bend_of_bathe_and_bolourchi(flipped):
    """Whatever the order and the directions of the cells."""
    x, cells = arc(16, 100, np.pi / 4), None
    if flipped:
        cells = np.column_stack([np.arange(16), np.arange(1, 17)])
        cells[::3] = cells[::3, ::-1]
        cells = np.random.default_rng(0).permutation(cells)
    section = nts.Section(
        EA=1e7, GA=(5e6, 5e6), GJ=1e7 / 12, EI=(1e7 / 12,) * 2, rhoA=1, rhoI=(1 / 12, 1 / 12)
    )
    beam = nts.Beam(
        interval_mesh(x, cells),
        section,
        bcs=[nts.Clamp(lambda x: x[0] < 1e-9)],
        forces=[nts.PointForce(lambda y: y[0] > x[-1, 0] - 1e-6, (0, 0, 600))],
    )
    nts.equilibrium(nts.System([beam]), load_steps=5)
    assert beam.centreline()[1][-1] == pytest.approx(
        (46.92646809, 15.69722311, 53.66556033), abs=1e-7
    )


def test_a_propped_cantilever_under_its_weight():
    """Clamped, and a support that holds the place and not the directions: 3/8 q L there."""
    section = nts.Section(EA=1e9, GA=(1e12,) * 2, GJ=1e6, EI=(1e6, 1e6), rhoA=10, rhoI=(0.1, 0.1))
    bcs = [
        nts.Clamp(lambda x: x[0] < 1e-9),
        nts.Dirichlet(lambda x: x[0] > 4 - 1e-9, components=(2,)),
    ]
    beam = nts.Beam(interval_mesh(straight(64, 4)), section, bcs=bcs)
    run = nts.equilibrium(nts.System([beam], gravity=(0, 0, -9.81)), load_steps=1)
    load = 10 * 9.81 * 4
    forces = run.reactions["beam"][-1][:, 2]
    assert run.status == "completed"
    assert forces == pytest.approx((5 / 8 * load, 3 / 8 * load), rel=1e-3)


@pytest.mark.mpi
def test_a_force_per_length():
    """On the outer half of a cantilever: deflections by Euler and Bernoulli; reactions."""
    section = nts.Section(EA=1e9, GA=(1e12,) * 2, GJ=1e6, EI=(1e6, 1e6), rhoA=10, rhoI=(0.1, 0.1))
    length, q = 4.0, 30.0
    clamp = nts.Clamp(lambda x: x[0] < 1e-9)
    outer = nts.LineForce((0, 0, -q), where=lambda x: x[0] > length / 2 - 1e-9)
    beam = nts.Beam(interval_mesh(straight(64, length)), section, bcs=[clamp], forces=[outer])
    run = nts.equilibrium(nts.System([beam]))
    # 41/384 q L^4 / EI of a load over the half at the free end.
    deflection = 41 / 384 * q * length**4 / 1e6
    assert run.reactions["beam"][-1, 0] == pytest.approx((0, 0, q * length / 2), abs=1e-5)
    assert beam.centreline()[1][-1, 2] == pytest.approx(-deflection, rel=1e-3)


def test_a_force_per_length_is_like_weight():
    """Everywhere, as a function of time, in dynamics: the same motion as by gravity."""
    load = nts.LineForce(lambda t: (0, -9.81 * STEEL.rhoA, 0))
    ends = []
    for forces, gravity in (([load], (0, 0, 0)), ([], (0, -9.81, 0))):
        beam = nts.Beam(interval_mesh(arc(6, 2.0, 1.0)), STEEL, forces=forces,
                        bcs=[nts.Clamp(lambda x: x[0] < 1e-9)])  # fmt: skip
        run = nts.simulate(nts.System([beam], gravity=gravity), EM, dt=0.02, t_end=0.1)
        ends.append((beam.centreline()[1], run.balance["external_work"]))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-12)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-12)


# ---- dynamics
@pytest.mark.parametrize(("n", "mass"), [(4, 1.0), (10, 100.0)])
def test_a_taut_wire_carries_what_hangs_on_it(n, mass):
    """B41: thin as it is, it stretches by 2 m g L / EA at most, however its sections may turn."""
    section = nts.Circle(5e-4).section(young=2.1e11, poisson=0.3, density=7.8e3)
    wire = nts.Beam(interval_mesh(straight(n, way=(0, 0, -1))), section, name="wire",
                    bcs=[nts.Clamp(lambda x: x[2] > -1e-9)])  # fmt: skip
    load = nts.RigidBody.from_inertia(
        mass, (1e-2,) * 3, (0, 0, -1), velocity=(0.01, 0, 0), name="load"
    )
    joint = nts.Spherical(wire, load, point=(0, 0, -1))
    system = nts.System([wire, load], joints=[joint], gravity=(0, 0, -9.81))
    stepper, lowest = nts.Stepper(system, EM, project_start=True), []
    for _ in range(20):
        stepper.advance(2e-3)
        lowest.append(load.position[2])
    stepper.close()
    # Half of the wire's own weight pulls on it, too.
    weight = 9.81 * (mass + 0.5 * section.rhoA)
    assert -2 * weight / section.EA < 1 + min(lowest) < 0.0


def flying(scale, comm):
    """B29 in a unit of length 1/scale m."""
    s = scale
    section = nts.Section(
        EA=1e4 * s, GA=(1e4 * s,) * 2, GJ=500 * s**3, EI=(500 * s**3,) * 2, rhoA=1 / s,
        rhoI=(10 * s,) * 2,
    )  # fmt: skip
    return nts.Beam(
        interval_mesh(straight(8, 10 * s), comm=comm),
        section,
        velocity=lambda x: np.array([0, 0, 0.5 * s])[:, None] * np.cos(np.pi * x[0] / (10 * s)),
        angular_velocity=(0.3, 0.5, 1),
    )


def off(run):
    """Errors of E and J over their size."""
    energy, spin = run.balance["energy"], run.balance["angular_momentum"]
    return (
        np.abs(energy / energy[0] - 1).max(),
        np.abs(spin - spin[0]).max() / np.linalg.norm(spin[0]),
    )


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize("loaded", ["directors", "rigid tip"])
@pytest.mark.parametrize(("n", "gap"), [(32, 0.0271), (52, 0.01), (64, 0.0066)])
def test_an_end_moment_rolls_a_strip_up(n, gap, loaded):
    """2 pi EI / L, a full circle: as the closed form of these elements says, to rounding.

    An element that bends by an angle a has the strain sin(a) / length. So the moment is
    EI sin(2 a) / (2 length), and no force leaves chords as long as they were: order 2, 1 % takes
    52 elements.
    """
    stiffness, where = 2.0, lambda x: x[0] > 1 - 1e-9
    moment = (0, 0, 2 * np.pi * stiffness)
    section = nts.Section(EA=1e4, GA=(5e3, 5e3), GJ=2, EI=(stiffness,) * 2, rhoA=1,
                          rhoI=(1e-2, 1e-2))  # fmt: skip
    rigid = loaded == "rigid tip"
    beam = nts.Beam(interval_mesh(straight(n)), section, bcs=[nts.Clamp(lambda x: x[0] < 1e-9)],
                    forces=[] if rigid else [nts.PointMoment(where, moment)])  # fmt: skip
    bodies, joints = [beam], []
    if rigid:
        bodies.append(nts.RigidBody.from_inertia(
            1e-3, (1e-5,) * 3, (1, 0, 0), name="tip", torque=moment, comm=MPI.COMM_WORLD
        ))  # fmt: skip
        joints.append(nts.Fixed(*bodies, point=(1, 0, 0)))
    run = nts.equilibrium(nts.System(bodies, joints=joints), load_steps=10)
    angle = 0.5 * np.arcsin(4 * np.pi / n)
    k = np.arange(n) + 0.5
    steps = np.column_stack([np.cos(k * angle), np.sin(k * angle), 0 * k])
    expected = np.cumsum(steps, axis=0) / n
    _, now = beam.centreline()
    assert run.status.startswith("completed")
    assert now[1:] == pytest.approx(expected, abs=1e-10)
    assert np.linalg.norm(now[-1]) < gap


# ---- sections of shapes
def test_torsion_constants_of_rectangles():
    """Roark's formulas for stress and strain, table 10.7 (to three digits); a thin strip."""
    for ratio, factor in ((1, 0.141), (1.5, 0.196), (2, 0.229), (3, 0.263), (10, 0.312)):
        for b, h in ((0.2 * ratio, 0.2), (0.2, 0.2 * ratio)):
            section = nts.Rectangle(b, h).section(young=2.0, poisson=0.0, density=1.0)
            assert section.GJ == pytest.approx(factor * 0.2 * ratio * 0.2**3, rel=4e-3)


def test_sections_of_shapes_by_quadrature():
    """Area and second moments of a cloud of points; G A and G J of the circle in closed form."""
    b, h, n = 0.3, 0.1, 400
    x, y = (s * ((np.arange(n) + 0.5) / n - 0.5) for s in (b, h))
    first, second = np.meshgrid(x, y, indexing="ij")
    for shape, inside in (
        (nts.Rectangle(b, h), np.ones_like(first)),
        (nts.Circle(h / 2), first**2 + second**2 < (h / 2) ** 2),
    ):
        found = shape.section(young=3.0, poisson=0.25, density=2.0)
        weights = b * h / n**2 * inside
        moments = (weights * second**2).sum(), (weights * first**2).sum()
        assert found.EA == pytest.approx(3 * weights.sum(), rel=2e-3)
        assert found.rhoA == pytest.approx(2 * weights.sum(), rel=2e-3)
        assert found.EI == pytest.approx(3 * np.array(moments), rel=2e-3)
        assert found.rhoI == pytest.approx(2 * np.array(moments), rel=2e-3)
    circle = nts.Circle(0.1).section(young=2.6, poisson=0.3, density=1.0)
    assert circle.GJ == pytest.approx(np.pi * 0.1**4 / 2)
    assert circle.GA == pytest.approx([np.pi * 0.01 * 0.886] * 2, rel=1e-3)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: nts.Circle(0.0), "^radius=0.0: must be positive"),
        (lambda: nts.Rectangle(1.0, np.inf), "^height=inf"),
        (lambda: nts.Circle(1).section(young=-1, poisson=0, density=1), "^young=-1"),
        (lambda: nts.Circle(1).section(young=1, poisson=0.6, density=1), "^poisson=0.6: must lie"),
        (lambda: nts.Circle(1).section(young=1, poisson=-7 / 6, density=1), "^poisson=-1.16"),
        (lambda: nts.Rectangle(1, 1).section(young=1, poisson="x", density=1), "^poisson='x'"),
        (lambda: nts.Rectangle(1, 1).section(young=1, poisson=0, density=0), "^density=0"),
    ],
)
def test_shapes_that_are_none_are_told(make, text):
    with pytest.raises(ValueError, match=text):
        make()


def first_frequency(section, length):
    """Of a cantilever by Timoshenko's equations [rad/s] (Huang, J. Appl. Mech. 28, 1961)."""
    stiffness, mass = section.EI[0], section.rhoA
    r2, s2 = section.rhoI[0] / mass / length**2, stiffness / section.GA[0] / length**2

    def lack(b):
        root = np.sqrt((r2 - s2) ** 2 + 4 / b**2)
        alpha, beta = (np.sqrt(0.5 * (k * (r2 + s2) + root)) for k in (-1, 1))
        both = np.cosh(b * alpha) * np.cos(b * beta), np.sinh(b * alpha) * np.sin(b * beta)
        return (2 + (b**2 * (r2 - s2) ** 2 + 2) * both[0]
                - b * (r2 + s2) / np.sqrt(1 - b**2 * r2 * s2) * both[1])  # fmt: skip

    return brentq(lack, 1.0, 4.0) * np.sqrt(stiffness / (mass * length**4))


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.02, 0.2])
def test_the_first_frequency_of_a_cantilever(height):
    """Slender, where Euler and Bernoulli are right, and a fifth as thick as long."""
    section = nts.Rectangle(0.05, height).section(young=2e11, poisson=0.3, density=7800)
    exact = first_frequency(section, 1.0)
    if height < 0.05:
        thin = 1.875104**2 * np.sqrt(section.EI[0] / section.rhoA)
        assert exact == pytest.approx(thin, rel=1e-3)
    # Like the first shape, and so small that it stays linear: a node of the beam never turns 1e-3.
    speed = 1e-4 * exact
    beam = nts.Beam(
        interval_mesh(straight(16)), section, bcs=[nts.Clamp(lambda x: x[0] < 1e-9)],
        direction=(0, 1, 0), velocity=lambda x: speed * np.stack([0 * x[0], 0 * x[0], x[0] ** 2]),
    )  # fmt: skip
    period = 2 * np.pi / exact
    stepper, places = nts.Stepper(nts.System([beam]), EM), [0.0]
    for _ in range(170):
        stepper.advance(period / 80)
        places.append(beam.centreline()[1][-1, 2])
    stepper.close()
    places = np.array(places)
    falls = np.flatnonzero((places[:-1] > 0) & (places[1:] <= 0))
    at = falls + places[falls] / (places[falls] - places[falls + 1])
    # Half a period, then whole ones.
    assert len(at) == 2
    assert (at[1] - at[0]) / 80 == pytest.approx(1.0, abs=0.01)


# ---- joints
@pytest.mark.mpi
def test_a_root_held_by_a_joint_is_clamped():
    section = nts.Section(EA=2000, GA=(800, 800), GJ=1, EI=(1, 1), rhoA=1, rhoI=(1e-2, 1e-2))
    tip = nts.PointForce(lambda x: x[0] > 1 - 1e-9, (0, 10, 0))
    beam = nts.Beam(interval_mesh(straight(8)), section, forces=[tip])
    held = nts.Fixed(beam, None, point=(0, 0, 0))
    nts.equilibrium(nts.System([beam], joints=[held]), load_steps=5)
    assert beam.centreline()[1][-1] == pytest.approx((*TIPS[8], 0.0), abs=1e-8)


def test_a_joint_between_nodes_is_told():
    beam = nts.Beam(interval_mesh(straight(4)), STEEL)
    with pytest.raises(ValueError, match=r"is no node of beam 'beam'; the nearest one is \[0.0"):
        nts.Spherical(beam, None, point=(0.1, 0, 0))
    with pytest.raises(ValueError, match=r"a='beam': .* or fix one to a node of a beam"):
        nts.TorsionDamper(beam, None, axis=(0, 0, 1), damping=1.0)


# ---- bad input
def box():
    return create_box(MPI.COMM_WORLD, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("given", "kind", "text"),
    [
        ({"mesh": lambda: "line"}, TypeError, "pass a dolfinx mesh"),
        ({"mesh": box}, ValueError, "hexahedron in 3D; pass intervals"),
        ({"mesh": lambda: interval_mesh(straight(2)[:, :2])}, ValueError, "interval in 2D"),
        ({"mesh": lambda: interval_mesh([[0, 0, 0], [1, 0, 0], [1, 0, 0]])}, ValueError,
         "1 cells have no length"),
        ({"mesh": lambda: interval_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
                                        [[0, 1], [0, 2], [0, 3]])}, ValueError,
         # On DOLFINx 0.9 two ranks find a corner there.
         "3 cells meet|axis turns by 90 degrees"),
        ({"mesh": lambda: interval_mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]])}, ValueError,
         "turns by 90 degrees"),
        ({"mesh": lambda: interval_mesh([[0, 0, 0], [1, 0, 0], [np.nan, 0, 0]])}, ValueError,
         "not finite"),
        ({"section": 3}, TypeError, "section=3: pass Section"),
        ({"direction": (1, 0, 0)}, ValueError, "along the axis at x=.*across it everywhere"),
        ({"direction": (1, 0)}, ValueError, "three finite components"),
        ({"bcs": [3]}, TypeError, r"bcs\[0\]=3: pass a sequence of Clamp or Dirichlet"),
        ({"bcs": [nts.Clamp(lambda x: x[0] > 7)]}, ValueError,
         r"^Clamp.where of bcs\[0\] of 'beam': selects no node between.*; the nodes are"),
        ({"bcs": [nts.Clamp("root")]}, TypeError, "pass a function"),
        ({"forces": [nts.PointForce(lambda x: x[0] > 0.1, (1, 0, 0))]}, ValueError,
         "selects 4 nodes; select one"),
        ({"forces": [nts.PointForce(lambda x: x[0] > 0.9, 1.0)]}, ValueError, "three finite"),
        ({"forces": [nts.LineForce((1, 0, 0), lambda x: x[0] > 0.9)]}, ValueError,
         r"LineForce.where of forces\[0\] of 'beam'=.*selects no two neighbours; select both"),
        ({"forces": [nts.LineForce(1.0)]}, ValueError, "three finite"),
        ({"velocity": "fast"}, ValueError, "velocity='fast'"),
        ({"spin": 1}, TypeError, "unknown option of Beam"),
    ],
)  # fmt: skip
def test_bad_input_is_told(given, kind, text):
    options = {"mesh": lambda: interval_mesh(straight(4)), "section": STEEL} | given
    mesh = options.pop("mesh")()
    with pytest.raises(kind, match=text):
        nts.Beam(mesh, **options)


@pytest.mark.parametrize(
    "wrong", [{"EA": 0.0}, {"GA": (1, -1)}, {"EI": 3.0}, {"rhoI": (1, np.inf)}, {"GJ": None}]
)
def test_a_section_must_be_positive(wrong):
    good = {"EA": 1, "GA": (1, 1), "GJ": 1, "EI": (1, 1), "rhoA": 1, "rhoI": (1, 1)}
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}=.*positive"):
        nts.Section(**good | wrong)
