"""`bending=True` against an independent program, closed forms and finite differences."""

import numpy as np
import pytest
from cells import DEFLECTION, bar, between, differences, distorted, own_energy
from integrators import MID_STEP
from rotations import rotation
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.bodies.solid.step_forms import fill
from dolfinx_nts.integrators.static import EQUILIBRIUM
from dolfinx_nts.interaction.evaluation import EvaluationPoint

OF = {"neo-Hookean": nts.NeoHookean(young=1.0, poisson=0.3), "own": own_energy}


def body_of(mesh, material=None, **options):
    given = {"density": 1e3, "bending": True, **options}
    return nts.Continuum(mesh, material or nts.NeoHookean(young=1e6, poisson=0.3), **given)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("cells", "poisson", "share"),
    [
        ((20, 2, 2), 0.3, 99.4), ((20, 1, 1), 0.3, 99.9), ((10, 1, 1), 0.3, 99.3),
        ((20, 2, 2), 0.4999, 84.7), ((20, 1, 1), 0.4999, 82.6), ((20, 2, 2), 0.499999, 74.5),
    ],
)  # fmt: skip
def test_bars_bend_as_in_another_program(cells, poisson, share):
    """Theory 19.5, per cent of the reference; without modes 88, 80, 65, 20, 18 and 1."""
    found = bar(cells, poisson, bending=True) / DEFLECTION[poisson]
    assert 100.0 * found == pytest.approx(share, abs=0.1)


def test_a_strip():
    """A strip of 10 x 1 x 0.1: responses of theory 19.7 to a per cent, .995, .998 and .093."""
    ends = []
    for options in ({}, {"bending": False, "degree": 2}, {"bending": False}):
        body = body_of(
            box(np.zeros(3), np.array([10.0, 1.0, 0.1]), (20, 2, 2)),
            nts.NeoHookean(young=1.0, poisson=0.3),
            bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9)],
            traction=[nts.Traction(lambda x: x[0] > 10 - 1e-9, (0.0, 0.0, 1e-9))], **options,
        )  # fmt: skip
        assert nts.equilibrium(nts.System([body])).status == "completed"
        ends.append(np.abs(body.u.x.array.reshape(-1, 3)[:, 2]).max())
    assert ends[0] / ends[1] == pytest.approx(0.995 / 0.998, abs=0.01)
    assert ends[2] / ends[1] == pytest.approx(0.093 / 0.998, abs=0.01)


# ---- forces
def relaxed(body, rule, u0, u1):
    """Forces between two displacements, where the body starts with the modes of the first."""
    inner = body.inner_at_rest(u0)
    body.begin_step(rule, EvaluationPoint(u0, 0.0, inner=inner))
    return body.internal(u1), inner, body.inner(u1)


def energy(body, u, inner):
    body.take_inner(inner)
    return body.potential(u)


@pytest.mark.parametrize("name", OF)
def test_forces_are_the_slope_of_the_energy(name):
    """Of the energy with the modes that make it least."""
    body = body_of(distorted(), OF[name])
    _, u = between(body)

    def stored(u):
        return energy(body, u, body.inner_at_rest(u))

    found, *_ = relaxed(body, EQUILIBRIUM, u, u)
    slope = differences(stored, u)
    assert np.abs(found - slope).max() < 1e-9 * np.abs(slope).max()


@pytest.mark.parametrize(
    ("name", "size"), [("neo-Hookean", 1.0), ("neo-Hookean", 1e-6), ("own", 1.0)]
)
def test_work_is_the_change_of_the_energy(name, size):
    body = body_of(distorted(), OF[name])
    u0, u1 = size * between(body)
    forces, before, after = relaxed(body, nts.EnergyMomentum(), u0, u1)
    change = energy(body, u1, after) - energy(body, u0, before)
    assert abs(forces @ (u1 - u0) - change) < 1e-13 * energy(body, u1, after)


@pytest.mark.parametrize("rule", [*MID_STEP.values(), EQUILIBRIUM], ids=[*MID_STEP, "static"])
def test_tangent(rule):
    """With some coordinates prescribed, whose rows and columns hold the diagonal alone."""
    body = body_of(distorted(), bcs=[nts.Dirichlet(lambda x: x[0] < 0.3, components=[1])])
    u0, u1 = between(body)
    relaxed(body, rule, u0, u1)
    matrix = body.tangent(u1, 0.0, 1.0)
    expected = differences(body.internal, u1)
    free = np.setdiff1d(np.arange(len(u1)), body.fixed)
    found = matrix[:, :]
    scale = np.abs(expected).max()
    assert np.abs((found - expected)[np.ix_(free, free)]).max() < 1e-8 * scale
    assert not found[np.ix_(body.fixed, free)].any() and not found[np.ix_(free, body.fixed)].any()


def test_uniform_strain_needs_no_modes():
    """Patch test with any affine motion, on distorted cells: forces and stress of the law."""
    mesh = distorted()
    bent, plain = body_of(mesh), body_of(mesh, bending=False)
    f = rotation(0.7, (1.0, 2.0, 3.0)) @ np.array([[1.3, 0.2, 0.0], [0.0, 0.9, 0.1], [0, 0, 1.1]])
    u = (bent.reference.reshape(-1, 3) @ (f - np.eye(3)).T).ravel()
    forces, inner, _ = relaxed(bent, EQUILIBRIUM, u, u)
    expected = plain._forms.forces(EQUILIBRIUM, u, u)
    assert np.abs(inner).max() < 1e-12
    assert np.abs(forces - expected).max() < 1e-12 * np.abs(expected).max()
    bent.take_inner(inner)
    stresses = []
    for body in (bent, plain):
        fill(body.u, u)
        stresses.append(nts.cauchy_stress(body).x.array)
    assert np.abs(stresses[0] - stresses[1]).max() < 1e-11 * np.abs(stresses[1]).max()


# ---- motion
def spinning(**options):
    """A bar of one layer that bends and spins, thrown."""

    def thrown(x):
        return np.array([0.3 * x[2], 4.0 * (x[0] - 1.0), 2.0 * np.cos(x[0])])

    mesh = box((0.0, 0.0, 0.0), (2.0, 0.4, 0.2), (6, 2, 1))
    return nts.System([body_of(mesh, nts.NeoHookean(1e5, 0.3), velocity=thrown, **options)])


@pytest.mark.mpi
def test_a_body_starts_bent():
    """What is released from a bent place has the modes of it: equilibrium, then the run."""
    load = nts.Traction(lambda x: x[0] > 2 - 1e-9, lambda t: (0.0, 0.0, 300.0 * min(t, 1.0)))
    held = {"bcs": [nts.Dirichlet(lambda x: x[0] < 1e-9)], "velocity": (0, 0, 0)}
    mesh = box((0.0, 0.0, 0.0), (2.0, 0.4, 0.2), (6, 2, 1))
    bent = nts.System([body_of(mesh, nts.NeoHookean(1e5, 0.3), traction=[load], **held)])
    static = nts.equilibrium(bent)
    free = nts.System([body_of(mesh, nts.NeoHookean(1e5, 0.3), **held)])
    run = nts.simulate(
        free, nts.EnergyMomentum(), dt=5e-3, t_end=0.05, start=static, start_time=0.0
    )
    energy = run.balance["energy"]
    assert energy[0] == pytest.approx(static.balance["potential"][-1], rel=1e-12)
    assert np.abs(energy - energy[0]).max() < 1e-11 * energy[0]
    u = static.state.u[0]
    moved = nts.System(
        [body_of(mesh, nts.NeoHookean(1e5, 0.3), displacement=_function(bent.bodies[0], u), **held)]
    )
    assert nts.simulate(moved, nts.EnergyMomentum(), dt=5e-3, t_end=5e-3).balance["energy"][
        0
    ] == pytest.approx(energy[0], rel=1e-9)


def _function(body, u):
    fill(body.u, u)
    return body.u


# ---- told and refused
@pytest.mark.mpi
def test_compressed_cells_are_told():
    """Where the least eigenvalue of C falls below 0.56 (theory 19.4), and not before."""
    for pressed, told in ((0.22, False), (0.28, True)):
        body = body_of(
            box(cells=(2, 2, 2)),
            bcs=[
                nts.Dirichlet(lambda x: x[2] < 1e-9, components=[2]),
                nts.Dirichlet(
                    lambda x: x[2] > 1 - 1e-9, lambda t, p=pressed: (0.0, 0.0, -p * min(t, 1.0)),
                    components=[2],
                ),
                nts.Dirichlet(lambda x: x[0] < 1e-9, components=[0]),
                nts.Dirichlet(lambda x: x[1] < 1e-9, components=[1]),
            ],
        )  # fmt: skip
        run = nts.equilibrium(nts.System([body]))
        assert ("folding cells" in run.warnings) == told


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"degree": 2}, "hexahedrons of degree 2"),
        ({"volume": "projected"}, "would undo its bending"),
        ({"bending": 1}, "bending=1"),
    ],
)
def test_refused(options, told):
    with pytest.raises((ValueError, TypeError), match=told):
        body_of(box(cells=(2, 2, 2)), **options)


def arc(cells):
    """A quarter of a ring of radius 50 and thickness 1 in one layer, and its stiffness in radii."""
    mesh = box((0, 0, 0), (np.pi / 2, 10, 1), (cells, 1, 1))
    x = mesh.geometry.x
    angle, radius = x[:, 0].copy(), 49.5 + x[:, 2]
    x[:, 0], x[:, 2] = radius * np.sin(angle), radius * np.cos(angle)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1.0, poisson=0.0), density=1.0, bending=True,
        bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9)],
        traction=[nts.Traction(lambda x: x[2] < 1e-9, (0.0, 0.0, -1e-9))],
    )  # fmt: skip
    return body, lambda x: x[2] < 1e-9


def test_cells_of_an_arc():
    """Beside Euler and Bernoulli's arc, F R^3/EI int (1 - sin)^2; coarse ones are told."""
    right = 1e-8 * 50.0**3 * 12.0 / 10.0 * (0.75 * np.pi - 2.0)
    for cells, low, told in ((24, 0.985, False), (12, 0.9, True)):
        body, end = arc(cells)
        run = nts.equilibrium(nts.System([body]), load_steps=1)
        x = body.space.tabulate_dof_coordinates()
        found = -body.u.x.array.reshape(-1, 3)[end(x.T), 2].mean() / right
        assert low < found < 1.005
        assert ("distorted cells" in run.warnings) == told
        assert found > 0.98 or told


@pytest.mark.parametrize("bends", [(True, False), (False, True)])
def test_going_on_with_other_cells(bends, tmp_path):
    """A checkpoint is refused; an equilibrium is taken over, with the modes of its displacement."""
    held = {"bcs": [nts.Dirichlet(lambda x: x[0] < 1e-9)]}
    load = nts.Traction(lambda x: x[0] > 2 - 1e-9, lambda t: (0.0, 0.0, 300.0 * min(t, 1.0)))
    mesh = box((0.0, 0.0, 0.0), (2.0, 0.4, 0.2), (6, 2, 1))
    one, other = (
        nts.System([body_of(mesh, nts.NeoHookean(1e5, 0.3), bending=bend, traction=more, **held)])
        for bend, more in zip(bends, ([load], []), strict=True)
    )
    static = nts.equilibrium(one)
    run = nts.simulate(
        other, nts.EnergyMomentum(), dt=5e-3, t_end=0.02, start=static, start_time=0.0
    )
    body = other.bodies[0]
    expected = energy(body, static.state.u[0], body.inner_at_rest(static.state.u[0]))
    assert run.balance["energy"][0] == pytest.approx(expected, rel=1e-12)
    path = tmp_path / "state.h5"
    nts.simulate(
        one, nts.EnergyMomentum(), dt=5e-3, t_end=5e-3, checkpoint=nts.Checkpoint(path, every=1)
    )
    with pytest.raises(ValueError, match="bending"):
        nts.restart(path, other)
