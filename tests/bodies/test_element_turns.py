"""Elements of beams and shells that turn too far to bend as they should: theory section 20."""

from mpi4py import MPI

import numpy as np
import pytest
from lines import interval_mesh, straight
from shells import plate

import dolfinx_nts as nts
from dolfinx_nts.bodies.slender import turns
from dolfinx_nts.solve.failure import diagnosis

SECTION = nts.Section(EA=1e4, GA=(5e3, 5e3), GJ=2, EI=(2, 2), rhoA=1, rhoI=(1e-2, 1e-2))
SENTENCE = "turns by 90 degrees between neighbouring nodes near X = "


def clamp(x):
    return x[0] < 1e-9


def tip(x):
    return x[0] > 1 - 1e-9


def turned(degrees, scale=1.0, degree=1):
    """One element whose end a rigid body turns by so much until t = 1."""
    s = scale
    section = nts.Section(EA=1e4 * s, GA=(5e3 * s,) * 2, GJ=2 * s**3, EI=(2 * s**3,) * 2,
                          rhoA=1 / s, rhoI=(1e-2 * s,) * 2)  # fmt: skip
    beam = nts.Beam(interval_mesh(straight(1, s)), section, bcs=[nts.Clamp(clamp)], degree=degree)
    head = nts.RigidBody.from_inertia(
        1.0, (s**2,) * 3, (s, 0, 0), name="head", comm=MPI.COMM_WORLD,
        rotation=lambda t: (0, 0, np.radians(degrees) * t),
    )  # fmt: skip
    return nts.System([beam, head], joints=[nts.Fixed(beam, head, point=(s, 0, 0))])


@pytest.mark.mpi
@pytest.mark.parametrize("scale", [1, 1000])
def test_an_element_that_turns_too_far_is_told(scale):
    """With how many elements of 12.2 degrees there should be; up to 15 there is nothing to say."""
    run = nts.equilibrium(turned(14.9, scale), load_steps=4)
    assert run.status == "completed" and not run.warnings
    run = nts.equilibrium(turned(36.0, scale), load_steps=1)
    # sin(2 a) / (2 a) of the moment; from an arc on, cos(a)^2.
    assert "by 24 % if it was straight, by 35 % if it was an arc" in str(run.warnings)
    run = nts.equilibrium(turned(76.0, scale), load_steps=4)
    found = run.warnings["turn of an element"]
    assert found.first == 0.25 and found.about == ("beam",) and not found.grave
    assert found.worst == pytest.approx(1 - np.cos(np.radians(76.0)))
    middle = f"X = ({0.5 * scale:.4g}, 0, 0)"
    assert f"turns by 76 degrees between neighbouring nodes near {middle}" in found.text
    assert "about 7 elements are needed for 3 %, or 4 with degree=2, where it has 1" in found.text
    assert run.balance["min_det"] == pytest.approx(np.cos(np.radians(76 / 4 * np.arange(5))))


@pytest.mark.mpi
@pytest.mark.parametrize("degrees", [78.0, 86.0])
def test_of_three_nodes_neighbours_turn_by_40_degrees(degrees):
    """There they are as soft as beams of two nodes at 15."""
    run = nts.equilibrium(turned(degrees, degree=2), load_steps=8)
    assert run.status == "completed" and ("turn of an element" in run.warnings) == (degrees > 81)
    assert run.balance["min_det"][-1] == pytest.approx(np.cos(np.radians(degrees / 2)), rel=2e-3)


@pytest.mark.mpi
def test_a_step_that_turns_an_element_by_90_degrees_is_not_accepted():
    run = nts.equilibrium(turned(100.0), load_steps=10)
    assert run.balance["time"][-1] <= 0.9 and run.balance["min_det"].min() > 0.0
    assert "between neighbouring nodes near X = (0.5, 0, 0): too easy to bend by" in run.status
    assert "; about 8 elements are needed for 3 %" in run.status


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.fast_on_ranks()
def test_how_soft_an_element_is(degree):
    """The moment, by differences of the energy, is that which the message says is missing."""
    system = turned(88.0, degree=degree)
    run = nts.equilibrium(system, load_steps=22)
    turn = np.radians(88.0) * run.balance["time"]
    moment = np.diff(run.balance["potential"]) / np.diff(turn)
    part = moment / (2.0 * 0.5 * (turn[1:] + turn[:-1]))
    beam = system.bodies[0]
    said = [turns.moments(beam._felt, a / degree)[0] for a in 0.5 * (turn[1:] + turn[:-1])]
    assert np.allclose(part, said, atol=2e-3)


@pytest.mark.parametrize("cells, missing", [(3, 0.25), (6, 0.067)])
def test_an_arc_of_too_few_beams_is_told(cells, missing):
    """A quarter circle of chords under a small moment at its end: cos(a)^2 of its stiffness."""
    a = np.linspace(0, np.pi / 2, cells + 1)
    moment = 1e-3
    push = nts.PointMoment(lambda x: x[0] > 1 - 1e-9, (0, 0, moment))
    beam = nts.Beam(interval_mesh(np.column_stack([np.sin(a), 1 - np.cos(a), 0 * a])), SECTION,
                    direction=(0, 0, 1), bcs=[nts.Clamp(clamp)], forces=[push])  # fmt: skip
    run = nts.equilibrium(nts.System([beam]))
    turn = 2 * run.balance["potential"][-1] / moment
    assert 1 - moment * np.pi / 2 / 2 / turn == pytest.approx(missing, rel=0.05)
    told = run.warnings["turn of an element"].text
    assert f"by {100 * missing:.0f} % if it was an arc" in told


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_strip_of_too_few_beams_is_told():
    """An element bears EI / (2 length) at most, at a turn of 45 degrees."""
    load = nts.PointMoment(tip, (0, 0, 2 * np.pi * 2))
    beam = nts.Beam(interval_mesh(straight(8)), SECTION, bcs=[nts.Clamp(clamp)], forces=[load])
    run = nts.equilibrium(nts.System([beam]), load_steps=10)
    assert run.balance["time"][-1] == pytest.approx(8 / 2 / (2 * np.pi), rel=1e-2)
    assert "beam 'beam' turns by" in run.status and "elements are needed for 3 %" in run.status
    assert "more load steps" not in run.status


@pytest.mark.slow
def test_a_strip_of_too_few_shells_is_told():
    """An element bears EI / length at most, if it does not stretch."""
    moment = 2 * np.pi * 1.2e6 * 0.1**3 / 12 / 12.0
    shell = nts.Shell(
        plate(5, 1, 12.0, 1.0), young=1.2e6, poisson=0.0, thickness=0.1, density=1.0,
        bcs=[nts.Clamp(clamp)],
        forces=[nts.LineMoment((0, -moment, 0), where=lambda x: x[0] > 12 - 1e-9)],
    )  # fmt: skip
    run = nts.equilibrium(nts.System([shell]), load_steps=10)
    assert run.balance["time"][-1] == pytest.approx(5 / (2 * np.pi), rel=1e-2)
    assert "shell 'shell' turns by" in run.status and "times as many elements" in run.status
    assert "shell 'shell' turns by" in run.warnings["turn of an element"].text


def test_a_beam_that_a_moment_rolls_up_is_stopped():
    """In motion; more elements go on."""
    section = nts.Section(EA=1e4, GA=(1e4,) * 2, GJ=100, EI=(100,) * 2, rhoA=1, rhoI=(10,) * 2)
    first = nts.PointMoment(lambda x: x[0] < 1e-9, (0, 0, 60))
    beam = nts.Beam(interval_mesh(straight(2, 10.0)), section, forces=[first])
    run = nts.simulate(nts.System([beam]), nts.EnergyMomentum(), dt=0.02, t_end=2)
    assert SENTENCE in run.status and "elements are needed for 3 %" in run.status
    assert run.balance["min_det"].min() > 0.0 and "turn of an element" in run.warnings


def test_largest_residuals_are_at_places_of_nodes():
    """Also where the equation of a director is unsolved, which is named."""
    beam = nts.Beam(interval_mesh(straight(2)), SECTION)
    stepper = nts.Stepper(nts.System([beam]), nts.EnergyMomentum())
    stepper.start(1e-2)
    problem = stepper.problem
    problem.begin(stepper.state, 1e-2)
    for vector, text in ((4, "residual at X = (0.5, 0, 0)"),
                         (6, "residual of director 2 at X = (0.5, 0, 0)")):  # fmt: skip
        e = problem.evaluate(problem.x)
        e.bodies[0].residual[:] = 0.0
        e.bodies[0].residual[3 * vector] = 1.0
        assert text in diagnosis(problem, e, [()] * len(problem.elements), "why", 0)
    stepper.close()
