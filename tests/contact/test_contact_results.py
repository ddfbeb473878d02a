"""Moments of contacts, and what they do at nodes as DOLFINx Functions."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.contact.surfaces import Surface

COMM = MPI.COMM_WORLD
RUBBER = nts.NeoHookean(young=1e5, poisson=0.3)
RHO = 1e3


def block(low, high, cells, name, rigid=False, **options):
    mesh = box(low, high, cells)
    if rigid:
        return nts.RigidBody(mesh, density=RHO, name=name, **options)
    return nts.Continuum(mesh, RUBBER, density=RHO, name=name, **options)


def pushed(kind):
    """A block that is thrown obliquely onto a larger one, or onto a plane."""
    top = block(
        (0.3, 0.2, 1.0), (0.8, 0.7, 1.5), [2, 2, 2], "top",
        rigid=kind == "rigid slave", velocity=(1.0, 0.5, -3.0),
    )  # fmt: skip
    slave = top.surface(lambda x: x[2] < 1.0 + 1e-9)
    if kind == "plane":
        pair = nts.ContactPair(slave, nts.Plane((0, 0, 0.998), (0, 0, 1)), friction=0.3)
        return nts.System([top], contacts=[pair])
    base = block((0, 0, 0), (1, 1, 0.998), [3, 3, 2], "base", rigid=kind == "rigid master")
    master = base.surface(lambda x: x[2] > 0.998 - 1e-9, smoothing=kind == "smooth")
    return nts.System([top, base], contacts=[nts.ContactPair(slave, master, friction=0.3)])


def points(body, u):
    """Positions of the nodes of the body's mesh that this rank owns."""
    owned = body.space.dofmap.index_map.size_local
    return (body.space.tabulate_dof_coordinates() + u.x.array.reshape(-1, 3))[:owned]


def owned(function):
    count = function.function_space.dofmap.index_map.size_local
    return function.x.array.reshape(-1, 3)[:count]


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("kind", "integrator"),
    [
        ("facets", nts.EnergyMomentum()),
        ("facets", nts.Midpoint()),
        ("facets", nts.GeneralizedAlpha()),
        ("smooth", nts.EnergyMomentum()),
        ("rigid slave", nts.EnergyMomentum()),
        ("rigid master", nts.EnergyMomentum()),
        ("plane", nts.EnergyMomentum()),
    ],
    ids=lambda v: v if isinstance(v, str) else type(v).__name__,
)
@pytest.mark.fast_on_ranks("smooth-EnergyMomentum", "rigid master-EnergyMomentum")
def test_nodal_forces_add_up_on_both_sides(kind, integrator):
    system = pushed(kind)
    run = nts.Stepper(system, integrator, newton=nts.Newton(rtol=1e-12))
    force = np.zeros(3)
    while not force[2] > 0.0:
        before = [points(body, body.u) for body in system.bodies]
        run.advance(1e-3)
        force, moment = run.solution.contact_forces[-1, 0], run.solution.contact_moments[-1, 0]
    assert (np.abs([force, moment]) > 1e-3 * force[2]).all()
    for sign, body, x0 in zip((1, -1), system.bodies, before, strict=False):
        name = f"contact_load_{system.contacts[0].name}"
        load = owned(run.solution.contact_fields(body)[name])
        x = x0 + integrator.theta * (points(body, body.u) - x0)
        total = COMM.allreduce(load.sum(axis=0))
        turning = COMM.allreduce(np.cross(x, load).sum(axis=0))
        size = np.linalg.norm(force)
        assert np.abs(total - sign * force).max() < 1e-11 * size
        # Where contact forces keep the angular momentum: on both sides at the same arms.
        assert np.abs(turning - sign * moment).max() < 1e-10 * size
    run.close()


@pytest.mark.mpi
def test_moment_of_a_block_at_rest():
    """Weight, upwards, through the centre of mass, far from the origin."""
    body = block((2.0, 3.0, 1.0), (3.0, 5.0, 2.0), [2, 2, 2], "block")
    floor = nts.Plane((0, 0, 1.0), (0, 0, 1))
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1 + 1e-9), floor, friction=0.5)
    system = nts.System([body], contacts=[pair], gravity=(0, 0, -10.0))
    settled = nts.equilibrium(system, load_steps=3)
    weight = 2 * RHO * 10.0
    assert settled.contact_moments.shape == (4, 1, 3) and not settled.contact_moments[0].any()
    centre = nts.motion_of(body).centre
    moment = np.cross(centre, [0, 0, weight])
    assert np.abs(settled.contact_moments[-1, 0] - moment).max() < 1e-8 * weight
    fields = settled.contact_fields(body)
    load, pressure = (fields[f"contact_{n}_{pair.name}"] for n in ("load", "pressure"))
    assert np.abs(COMM.allreduce(owned(load).sum(axis=0)) - [0, 0, weight]).max() < 1e-8 * weight
    count = pressure.function_space.dofmap.index_map.size_local
    x = pressure.function_space.tabulate_dof_coordinates()[:count]
    bottom, values = x[:, 2] < 1 + 1e-9, pressure.x.array[:count]
    assert not values[~bottom].any() and (values[bottom] > 0).all()
    area = np.where(np.abs(x[:, 0] - 2.5) < 0.1, 0.5, 0.25)
    area *= np.where(np.abs(x[:, 1] - 4.0) < 0.1, 1.0, 0.5)
    assert COMM.allreduce((values * area)[bottom].sum()) == pytest.approx(weight, rel=1e-8)


@pytest.mark.mpi
def test_fields_are_what_the_state_remembers():
    system = pushed("facets")
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=4e-3)
    top, base = system.bodies
    pair, own = system.contacts[0], run.state.contacts[0]
    assert set(run.contact_fields(base)) == {f"contact_load_{pair.name}"}
    names = ("load", "force", "pressure", "gap", "status", "friction", "slip")
    fields = run.contact_fields(top)
    assert set(fields) == {f"contact_{n}_{pair.name}" for n in names}
    slave: Surface = pair.slave
    for name, values in (("force", own.force), ("gap", own.gap), ("slip", own.slip)):
        function = fields[f"contact_{name}_{pair.name}"]
        count = function.function_space.dofmap.index_map.size_local
        x = function.function_space.tabulate_dof_coordinates()[:count]
        at = {tuple(np.round(p, 9)): v for p, v in zip(x, function.x.array, strict=False)}
        everywhere = {k: v for part in COMM.allgather(at) for k, v in part.items()}
        found = [everywhere[tuple(np.round(p, 9))] for p in slave.reference[slave.share]]
        assert np.array_equal(found, values), name


@pytest.mark.mpi
def test_before_the_first_step_and_bad_bodies():
    system = pushed("facets")
    run = nts.Stepper(system, nts.EnergyMomentum())
    fields = run.solution.contact_fields(system.bodies[1])
    assert not next(iter(fields.values())).x.array.any()
    stranger = block((0, 0, 0), (1, 1, 1), [1, 1, 1], "stranger")
    with pytest.raises(ValueError, match="is not in the system of this run"):
        run.solution.contact_fields(stranger)
    run.close()
    ball = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="ball")
    single = nts.Stepper(nts.System([ball]), nts.EnergyMomentum())
    with pytest.raises(ValueError, match="body 'ball': has no mesh"):
        single.solution.contact_fields(ball)
    single.close()
