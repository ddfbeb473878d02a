"""B6: one mass on a rigid wall, which rebounds with |1 - 2 theta|, theta = g_0/(h v)."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from integrators import CONTACT_RULES
from pairs import pairs
from point_mass import MASS, SPEED, STEP, PointMass, PointSurface, mass_on_wall

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD


def run(system, integrator, steps, **newton):
    """Velocities of the mass after each step, shape (steps + 1, 3), and the Stepper."""
    stepper = nts.Stepper(system, CONTACT_RULES[integrator], newton=nts.Newton(**newton))
    v = [COMM.bcast(stepper.state.v[0])]
    for _ in range(steps):
        stepper.advance(STEP)
        v.append(COMM.bcast(stepper.state.v[0]))
    stepper.close()
    return np.array(v), stepper


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integrator", "theta", "turned"),
    pairs(CONTACT_RULES, [0.0, 0.25, 0.49, 0.51, 0.75, 1.0, 0.5], [False, True]),
)
@pytest.mark.fast_on_ranks("midpoint-0.75-False", "energy-momentum-0.75-True")
def test_rebound(integrator, theta, turned):
    system, q = mass_on_wall(theta * STEP * SPEED, turned=turned)
    v, stepper = run(system, integrator, 4)
    normal = v @ q[:, 2] / SPEED
    rows = stepper.solution.balance
    # The step that closes the gap leaves 2 theta - 1 of the speed; a step from contact reflects.
    expected = [-1.0, 1 - 2 * theta] + 3 * [abs(1 - 2 * theta)]
    assert np.allclose(normal, expected, rtol=0, atol=1e-12)
    assert np.allclose(v @ q[:, :2], 0.0, rtol=0, atol=1e-12)
    if theta not in (0.5, 1.0):
        # At 0.5 the mass rests on the wall, at 1 it arrives there at the end of a step.
        active = [0, 1, 0, 0, 0] if theta < 0.5 else [0, 1, 1, 0, 0]
        assert rows["active"].tolist() == active
    lost = 2 * MASS * SPEED**2 * theta * (1 - theta)
    energy = 0.5 * MASS * SPEED**2
    assert np.allclose(rows["contact_defect"][1:], lost, rtol=0, atol=1e-12 * energy)
    assert np.allclose(rows["energy"][1:], energy - lost, rtol=0, atol=1e-12 * energy)
    assert np.abs(rows["ledger_residual"]).max() < 1e-12 * energy
    assert rows["min_gap"].min() > -1e-12 * STEP * SPEED


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", CONTACT_RULES)
def test_rebound_with_the_solver_of_large_scenes(integrator):
    """Whose storage in blocks of nodes is not for bodies of the user's own."""
    theta = 0.25
    system, q = mass_on_wall(theta * STEP * SPEED)
    v, _ = run(system, integrator, 2, linear_solver="krylov")
    expected = [-1.0, 1 - 2 * theta, 1 - 2 * theta]
    assert np.allclose(v @ q[:, 2] / SPEED, expected, rtol=0, atol=1e-12)


@pytest.mark.mpi
def test_what_a_body_inherits():
    """Defaults of a body of one's own; what does not inherit them is refused."""
    mass = PointMass(COMM, MASS, (1.0, 2.0, 3.0), (0.5, 0.0, 1.0))
    n = mass.num_owned
    assert mass.mesh is None and mass.joints == () and not (mass.driven or mass.oriented)
    assert np.array_equal(mass.initial_displacement, np.zeros(n)) and mass.places.sum() == n // 3
    assert mass.reactions(np.ones(n), np.zeros(n)).shape == (0, 3) and mass.reaction_labels == []
    assert mass.smallest_det(np.zeros(n))[0] == np.inf and mass.file_order().tolist() == [0]
    assert np.array_equal(mass.weight(np.array([0.0, 0.0, -2.0])), [0.0, 0.0, -2.0 * MASS][:n])
    momentum = COMM.allreduce(mass.angular_momentum(np.zeros(n), MASS * mass.initial_velocity))
    assert np.allclose(momentum, np.cross([1.0, 2.0, 3.0], [0.5 * MASS, 0.0, MASS]), rtol=1e-15)
    with pytest.raises(TypeError, match=r"^body 'mass' has no points\(\): joints and springs need"):
        nts.Spherical(mass, None, point=(1.0, 2.0, 3.0))
    with pytest.raises(TypeError, match=r"^bodies\[0\]=3: .* inherits from nts.Body"):
        nts.System([3])


class Bare:
    """All that a body has, without being a `Body`."""

    def __init__(self, mass):
        self._mass = mass

    def __getattr__(self, name):
        return getattr(self._mass, name)


class Own(PointMass):
    """It keeps what is accepted its own way."""

    def accept(self, u, v):
        self.u, self.v = u.copy(), v.copy()


@pytest.mark.mpi
@pytest.mark.parametrize("make", [Own, lambda *of: Bare(PointMass(*of))], ids=["own", "bare"])
def test_a_body_that_overrides_what_a_run_tells_it(make):
    """v t after free flight, from the body's motion after the run."""
    mass = make(COMM, MASS, (1.0, 2.0, 3.0), (0.5, 0.0, 1.0))
    nts.simulate(nts.System([mass]), nts.Midpoint(), dt=STEP, t_end=5 * STEP)
    moved = np.array([1.0, 2.0, 3.0]) + 5 * STEP * np.array([0.5, 0.0, 1.0])
    assert nts.motion_of(mass).centre == pytest.approx(moved, rel=1e-14)


def test_motion_below_rounding_is_rest():
    """h v is lost when it is added to u: nothing is left to solve, which must not be a failure."""
    mass = PointMass(COMM, MASS, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    stepper = nts.Stepper(nts.System([mass]), nts.Midpoint())
    n = mass.num_owned
    stepper.state = replace(stepper.state, u=(np.full(n, 0.1),), v=(np.full(n, 1e-17),))
    for _ in range(2):
        stepper.advance(STEP)
    assert np.array_equal(stepper.state.u[0], np.full(n, 0.1))
    stepper.close()


def test_the_step_decides_what_is_lost():
    """Halving h at one gap moves theta, not the physics: e follows |1 - 2 theta|."""
    gap = 0.3 * STEP * SPEED
    for part in (1, 2):
        system, _ = mass_on_wall(gap)
        stepper = nts.Stepper(system, nts.EnergyMomentum())
        for _ in range(3 * part):
            stepper.advance(STEP / part)
        theta = gap * part / (STEP * SPEED)
        final = COMM.bcast(stepper.state.v[0])[2]
        assert np.isclose(final, abs(1 - 2 * theta) * SPEED, rtol=1e-12)
        stepper.close()


@pytest.mark.parametrize(("away", "motion"), [(0.2, 0.3), (0.4, 0.6), (0.45, 0.8), (0.45, 1.2)])
def test_a_ridge_is_no_gap_in_the_wall(away, motion):
    """A mass flies at a convex edge, from where neither facet faces it: it bounces, none is won."""
    speed, side = motion / STEP, np.sqrt(0.5)
    mesh = create_box(COMM, [[-2, -1, -2], [0, 1, 0]], [2, 2, 2], CellType.hexahedron)
    everywhere = nts.Dirichlet(lambda x: x[0] < 1)
    wall = nts.Continuum(
        mesh, nts.StVenantKirchhoff(young=1.0, poisson=0.3), density=1.0, bcs=[everywhere]
    )
    start = np.array([away * side + 0.01, 0.3, away * side - 0.01])
    mass = PointMass(COMM, 1.0, start, -speed * np.array([side, 0, side]))
    faces = wall.surface(lambda x: (x[0] > -1e-9) | (x[2] > -1e-9))
    system = nts.System([mass, wall], contacts=[nts.ContactPair(PointSurface(mass, start), faces)])
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    inside = []
    for _ in range(8):
        state = stepper.advance(STEP)
        x = start + state.u[0]
        inside.append(min(-x[0], -x[2]) > 1e-12 and min(x[0], x[2]) > -2)
    table = stepper.solution.balance
    assert table["active"].max() == 1
    assert not any(inside)
    assert table["energy"].max() <= table["energy"][0] * (1 + 1e-12)
    assert np.abs(table["ledger_residual"]).max() <= 1e-12 * table["energy"][0]
    stepper.close()
