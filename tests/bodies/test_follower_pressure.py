"""Pressure on the boundary of a continuum, which follows it or is dead."""

import numpy as np
import pytest
import ufl
from dolfinx.mesh import CellType, locate_entities_boundary, meshtags
from scenes import at, box, symmetry
from scipy.optimize import brentq

import dolfinx_nts as nts

YOUNG, POISSON = 1e6, 0.3
MATERIAL = nts.NeoHookean(young=YOUNG, poisson=POISSON)


def volume_of(body):
    """Volume inside the boundary of a body as it is [m^3]."""
    surface = body.boundary()
    x = surface.positions(body.u.x.array[: body.num_owned])
    a, b, c, *d = (x[surface.facets[:, k]] for k in range(surface.facets.shape[1]))
    triangles = [(a, b, c)] if not d else [(a, b, c), (a, c, d[0]), (a, b, d[0]), (b, c, d[0])]
    signed = sum(np.einsum("ni,ni->", p, np.cross(q, r)) for p, q, r in triangles) / 6
    return signed if not d else 0.5 * signed


@pytest.mark.mpi
@pytest.mark.parametrize("cell, options", [
    (CellType.hexahedron, {"degree": 1}), (CellType.tetrahedron, {"degree": 2}),
    (CellType.hexahedron, {"volume": "projected"}), (CellType.hexahedron, {"bending": True}),
])  # fmt: skip
def test_a_cube_under_pressure_all_around_shrinks_by_the_closed_form(cell, options):
    """Its Cauchy stress is -p: mu (s^2 - 1) + lambda ln J = -p J, all stretches s, J = s^3."""
    mu, lame = YOUNG / (2 + 2 * POISSON), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    p = 0.3 * YOUNG
    stretch = brentq(
        lambda s: mu * (s**2 - 1) + 3 * lame * np.log(s) + p * s**3, 0.1, 1.0, xtol=1e-14
    )
    body = nts.Continuum(
        box(cells=2, cell=cell), MATERIAL, density=1e3, bcs=symmetry(axes=(0, 1, 2)),
        traction=[nts.Pressure(p)], **options,
    )  # fmt: skip
    run = nts.equilibrium(nts.System([body]), load_steps=2)
    x = body.u.x.array[: body.num_owned] + body.reference
    assert run.status == "completed"
    assert x == pytest.approx(stretch * body.reference, abs=1e-8)


def blown(follower=True, rule=None, dt=1e-2, steps=20):
    """A free, turning cube that a pressure all around squeezes: the body and the run."""
    body = nts.Continuum(
        box(cells=2), MATERIAL, density=1e3, velocity=lambda x: np.cross([3.0, -1, 2], x.T).T,
        traction=[nts.Pressure(lambda t: 0.1 * YOUNG, follower=follower)],
    )  # fmt: skip
    run = nts.simulate(
        nts.System([body]), rule or nts.EnergyMomentum(), dt=dt, t_end=steps * dt, progress=False
    )
    return body, run


@pytest.mark.parametrize("rule", [nts.EnergyMomentum(), nts.Midpoint()])
def test_pressure_all_around_gives_no_momentum(rule):
    _, run = blown(rule=rule)
    for name in ("linear_momentum", "angular_momentum"):
        moved = np.asarray(run.balance[name])
        size = np.abs(run.balance["angular_momentum"]).max()
        assert np.abs(moved - moved[0]).max() < 1e-11 * size
    if rule == nts.EnergyMomentum():
        assert np.abs(run.balance["ledger_residual"]).max() < 1e-11 * run.balance["kinetic"][0]


def test_its_work_is_that_of_the_change_of_volume():
    """Off by a third-order term a step, so by the square of the step in all."""
    missed = []
    for dt in (1e-2, 5e-3):
        body, run = blown(dt=dt, steps=round(0.1 / dt))
        work = 0.1 * YOUNG * (1.0 - volume_of(body))
        missed.append(run.balance["external_work"][-1] / work - 1.0)
    assert abs(missed[1]) < 1e-3 and np.log2(missed[0] / missed[1]) == pytest.approx(2.0, abs=0.1)


def test_dead_pressure_is_the_traction_along_the_normal():
    def pulled(load):
        body = nts.Continuum(
            box(cells=2), MATERIAL, density=1e3, bcs=symmetry(axes=(0, 1, 2)), traction=[load]
        )
        assert nts.equilibrium(nts.System([body]), load_steps=1).status == "completed"
        return body.u.x.array

    dead = pulled(nts.Pressure(0.1 * YOUNG, at(2, 1.0), follower=False))
    assert dead == pytest.approx(pulled(nts.Traction(at(2, 1.0), (0, 0, -0.1 * YOUNG))), abs=1e-14)
    follows = pulled(nts.Pressure(0.1 * YOUNG, at(2, 1.0)))
    assert np.abs(follows - dead).max() > 1e-3 * np.abs(dead).max()


@pytest.mark.mpi
@pytest.mark.parametrize("tagged", [False, True])
def test_an_extra_form_may_have_facets_of_its_own(tagged):
    """On the face x = 1, by tags or by place, it is the same as a `Traction` there."""
    pull = (0.0, 0.0, 0.05 * YOUNG)

    def pulled(mesh, *tractions, **options):
        body = nts.Continuum(
            mesh, MATERIAL, density=1e3, bcs=symmetry(axes=(0, 1, 2)),
            traction=[nts.Pressure(0.1 * YOUNG, at(2, 1.0)), *tractions], **options,
        )  # fmt: skip
        assert nts.equilibrium(nts.System([body]), load_steps=1).status == "completed"
        return body.u.x.array

    mesh = box()
    facets = np.sort(locate_entities_boundary(mesh, 2, at(0, 1.0))).astype(np.int32)
    tags = meshtags(mesh, 2, facets, np.full(len(facets), 7, dtype=np.int32))
    there = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(mesh)[0], 0.999), 1.0, 0.0)
    ds = ufl.Measure("ds", mesh, subdomain_data=tags)(7) if tagged else ufl.ds

    def extra(u, v, w, t):
        return -(1.0 if tagged else there) * ufl.inner(ufl.as_vector(pull), w) * ds

    expected = pulled(box(), nts.Traction(at(0, 1.0), pull))
    assert pulled(mesh, extra_form=extra) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("value, text", [
    (lambda t: (1.0, 2.0), "Pressure.value of traction"), (np.nan, "finite number"),
    (ufl.SpatialCoordinate(box())[0], "is of UFL"),
])  # fmt: skip
def test_bad_values_are_refused(value, text):
    with pytest.raises((TypeError, ValueError, nts.UserFunctionError), match=text):
        body = nts.Continuum(box(), MATERIAL, density=1e3, traction=[nts.Pressure(value)])
        nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=1e-3, t_end=1e-3)
