"""A rope on a drum: how its tension decays by friction, in equilibrium and in time."""

from mpi4py import MPI

import numpy as np
import pytest
from shells import surface_mesh

import dolfinx_nts as nts

DRUM, THICKNESS, TAIL, PULL = 0.25, 0.006, 0.1, 10.0
SHAPES = {
    "circle": nts.Circle(THICKNESS / 2),
    "rectangle": nts.Rectangle(THICKNESS, THICKNESS),
}


def rope_on_drum(n, mu, shape, force):
    """A rope that lies on half a drum in n elements, with a tail on either side; one is held."""
    radius, angle = DRUM + THICKNESS / 2, np.linspace(np.pi, 0, n + 1)
    arc = radius * np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    x = np.vstack([(-radius, 0, -TAIL), arc, (radius, 0, -TAIL)])
    mesh = surface_mesh(x, np.arange(n + 2)[:, None] + [0, 1], MPI.COMM_WORLD, "interval")

    def end(side):
        return lambda x: (side * x[0] > 0) & (x[2] < -TAIL + 1e-9)

    rope = nts.Beam(
        mesh, SHAPES[shape].section(young=2e8, poisson=0.3, density=1e3), direction=(0, 1, 0),
        bcs=[nts.Dirichlet(end(1))], forces=[nts.PointForce(end(-1), force)], name="rope",
    )  # fmt: skip
    drum = nts.Cylinder((0, 0, 0), (0, 1, 0), DRUM, name="drum")
    return nts.System([rope], contacts=[nts.ContactPair(rope.surface(), drum, friction=mu)])


def tension(n, mu):
    """What is left of a tension of 1 behind n nodes of a rope that slips on half a drum.

    A node turns the rope by 2 b = pi/n. Friction F = mu N acts at the drum's radius R, tension T
    along chords at r cos b from the axis, r = R + c. No moment is left in the elements, as the drum
    holds the nodes: c F goes into shear forces in the ratio q to the tensions on either side.

        r cos b (T' - T) = F R,    2 r sin b q (T' + T)/2 = c F,
        N = (T' + T) sin b - q (T' - T) cos b

    With x = (T' - T)/(T' + T): r/R cos b x = mu (sin b - c/R cos^2 b/sin b x^2). For thin ropes on
    many nodes this is exp(-mu pi R/r), the capstan equation.
    """
    r, b = DRUM + THICKNESS / 2, np.pi / n / 2
    square = mu * (r - DRUM) / DRUM * np.cos(b) ** 2 / np.sin(b)
    x = np.roots([square, r / DRUM * np.cos(b), -mu * np.sin(b)]).max()
    return ((1 - x) / (1 + x)) ** n


def test_the_polygon_is_the_capstan_equation_in_the_limit():
    for mu in (0.1, 0.5):
        limit = np.exp(-mu * np.pi * DRUM / (DRUM + THICKNESS / 2))
        assert tension(12, mu) == pytest.approx(limit, rel=1e-2)
        # With few facets more, the moment c F of a node bends nothing, and shear takes it up.
        assert tension(60, mu) == pytest.approx(limit, rel=5e-3)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("n", "mu", "shape"),
    [
        (12, 0.1, "circle"),
        (12, 0.5, "rectangle"),
        (24, 0.3, "rectangle"),
        (24, 0.5, "circle"),
        (60, 0.3, "circle"),
        (60, 0.5, "rectangle"),
    ],
)
@pytest.mark.fast_on_ranks()
def test_tension_in_equilibrium(n, mu, shape):
    """Nothing presses at the start: how much each node may rub is known once the rope is taut."""
    system = rope_on_drum(n, mu, shape, (0, 0, -PULL))
    run = nts.equilibrium(system, load_steps=4)
    # Without `stabilization`: what is not solved in 25 iterations is cut.
    assert run.status == "completed" and run.retries == 0
    held = np.linalg.norm(run.reactions["rope"][1:, 0], axis=1)
    load = PULL * run.balance["time"][1:]
    np.testing.assert_allclose(held, tension(n, mu) * load, rtol=5e-3)


@pytest.mark.slow
def test_tension_in_time():
    """The load grows in 0.2 s, many periods of the rope's stretch, whose mean is taken."""
    n, mu, dt, ramp = 24, 0.3, 5e-3, 0.2
    system = rope_on_drum(n, mu, "circle", lambda t: (0, 0, -PULL * min(t / ramp, 1.0)))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=1.25 * ramp)
    assert run.status == "completed"
    time = run.balance["time"]
    load = PULL * np.minimum(time / ramp, 1.0)
    held = np.linalg.norm(run.reactions["rope"][:, 0], axis=1)
    late = time > 0.75 * ramp
    assert np.mean(held[late] / load[late]) == pytest.approx(tension(n, mu), rel=1e-2)
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-10 * run.balance["energy"].max()
