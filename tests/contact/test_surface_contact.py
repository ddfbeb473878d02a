"""Contact integrated over the slave's surface (theory section 17)."""

from mpi4py import MPI

import hertz
import numpy as np
import pytest
import two_blocks
from integrators import CONTACT_RULES
from measures import drift
from scenes import CELLS, RUBBER, at, box, rubbing_blocks, symmetry

import dolfinx_nts as nts
from dolfinx_nts.contact.nodal_pressure import carried_areas, pressures

COMM = MPI.COMM_WORLD
#: Momenta are kept as well as the equations are solved.
TIGHT = nts.Newton(rtol=1e-13)


# ---- patch test
def patch(cells, cell="hexahedron", metre=1.0, friction=0.0):
    """Two blocks of height 0.5, nu = 0, pressed together; rollers below and on two sides.

    Returns:
        Pressures at the slave's nodes over the applied one, range of each block's vertical strain
        and of its mean, both over the applied strain.
    """
    linear, bodies = nts.StVenantKirchhoff(1.0 / metre, 0.0), []
    # Slips end within the rounding of positions, which is a part of what strains move.
    strain = 1e-3 if friction else 1e-4
    for n, low in zip(cells, (0.5, 0.0), strict=True):
        load = nts.Traction(at(2, metre, metre), (0, 0, -strain / metre))
        mesh = box([0, 0, low * metre], [metre, metre, (low + 0.5) * metre], [n, n, 2], CELLS[cell])
        floor = [] if low else [nts.Dirichlet(at(2, 0.0, metre), components=(2,))]
        bodies.append(nts.Continuum(
            mesh, linear, density=1.0, degree=1, bcs=symmetry(metre) + floor, name=f"at {low}",
            traction=[load] if low else [],
        ))  # fmt: skip
    slave, master = (b.surface(at(2, 0.5 * metre, metre)) for b in bodies)
    pair = nts.ContactPair(slave, master, friction=friction, integration="surface")
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]))
    assert run.status == "completed"
    local = run.state.contacts[0].force / slave.area[slave.share]
    pressure = np.concatenate(COMM.allgather(local)) * metre / strain
    field = run.contact_fields(bodies[0])["contact_pressure_at_0.5-at_0.0"].x.array
    assert np.abs(field[field != 0.0] * metre / strain - 1).max() < 1e-8
    # Displacements are linear in z if the stress is uniform.
    off = [linear_part(b, metre) / (metre * strain) for b in bodies]
    return pressure, max(off)


def linear_part(body, metre):
    """Largest difference of the vertical displacements from the closest function of z."""
    x, u = (a.reshape(-1, 3)[:, 2] for a in (body.reference, body.u.x.array[: body.num_owned]))
    x, u = (np.concatenate(COMM.allgather(a)) for a in (x, u))
    basis = np.column_stack([np.ones_like(x), x / metre])
    return np.abs(u - basis @ np.linalg.lstsq(basis, u, rcond=None)[0]).max()


@pytest.mark.mpi
@pytest.mark.parametrize(("cells", "options"), [
    ((3, 2), {}), ((2, 3), {}), ((4, 3), {"friction": 0.3}), ((2, 6), {}), ((3, 3), {}),
    ((3, 2), {"cell": "tetrahedron"}),
])  # fmt: skip
@pytest.mark.fast_on_ranks("cells0-options0")
def test_uniform_pressure_between_any_meshes(cells, options):
    """Nodes against facets miss it by 8 to 34 %, and stresses by up to 100 % (B7)."""
    pressure, off = patch(cells, **options)
    assert len(pressure) == (cells[0] + 1) ** 2
    # Friction is solved to a part of the force, which it changes.
    assert max(np.abs(pressure - 1).max(), off) < (1e-9 if options.get("friction") else 1e-12)


@pytest.mark.mpi
@pytest.mark.slow
def test_an_equilibrium_has_the_pieces_of_its_own_places():
    """However many load steps lead there, and a run from it begins without a jump of gaps."""
    ends, defects = [], []
    for steps in (1, 4):
        system = leaning()
        run = nts.equilibrium(system, load_steps=steps)
        assert run.status == "completed"
        ends.append(run.state.u[1])
        rule = CONTACT_RULES["energy-momentum"]
        table = nts.simulate(system, rule, dt=1e-3, t_end=1.002, start=run).balance
        defects.append(abs(table["contact_defect"]).max() / table["energy"][0])
    size = COMM.allreduce(np.abs(ends[1]).max(), op=MPI.MAX)
    assert size > 0.02
    # Points that stayed those of a step's start would miss these by 1e-2 and 1e-3.
    assert COMM.allreduce(np.abs(ends[0] - ends[1]).max(), op=MPI.MAX) < 1e-6 * size
    assert max(defects) < 1e-6


def leaning():
    """A soft block pressed on a larger one, and drawn along it, that rollers hold on two sides."""
    blocks = []
    for n, low, high, name in (
        (2, [-0.2, -0.2, 0], [1.2, 1.2, 0.5], "lower"), (3, [0, 0, 0.5], [1, 1, 1], "upper"),
    ):  # fmt: skip
        force = [nts.Traction(at(2, 1.0), (3e4, 0, -1e5))]
        upper = name == "upper"
        blocks.append(nts.Continuum(
            box(low, high, [n, n, 2]), RUBBER, density=1e3, name=name,
            bcs=symmetry() if upper else [nts.Dirichlet(at(2, 0.0))],
            traction=force if upper else [],
        ))  # fmt: skip
    pair = nts.ContactPair(
        blocks[1].surface(at(2, 0.5)), blocks[0].surface(at(2, 0.5)), integration="surface"
    )
    return nts.System(blocks, contacts=[pair])


@pytest.mark.mpi
@pytest.mark.slow
def test_cylinders_that_press_each_other():
    """Hertz: curved bodies, which touch along a line at the start, where all means are open."""
    problem = hertz.PROBLEMS["cylinders"]
    run = nts.equilibrium(hertz.pressed(COMM, problem, integration="surface"), load_steps=2)
    assert run.status == "completed" and "unstable equilibrium" not in run.warnings
    fields, slave = run.contact_fields(run.system.bodies[0]), run.system.contacts[0].slave
    force = fields["contact_force_upper-lower"].x.array[:]
    # Hertz's theory knows no area but the undeformed one.
    press = run.contact_loads.pressing(0, run.state.contacts[0].force)
    pressure = pressures(slave, press, carried_areas(slave, slave.reference))
    x = fields["contact_force_upper-lower"].function_space.tabulate_dof_coordinates()[:, 0]
    half = hertz.half_width(problem, x, np.nan_to_num(force))
    peak = COMM.allreduce(pressure.max(initial=0.0), op=MPI.MAX)
    assert peak == pytest.approx(problem.peak, rel=0.01)
    if COMM.size == 1:  # ranks share nodes
        assert half == pytest.approx(problem.half_width, rel=0.01)


# ---- impact
def impact(rule, friction, t_end=0.1, **scene):
    """Two blocks that meet and slide, over surfaces."""
    system = rubbing_blocks(friction, integration="surface", **scene)
    return nts.simulate(system, CONTACT_RULES[rule], dt=2e-3, t_end=t_end, newton=TIGHT)


@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(("friction", "rubbed"), [(0.0, 0.0), (0.4, 2.072e-3)])
def test_two_blocks(friction, rubbed):
    """B1, whose figures are those of an independent program (theory sections 17.4 and 17.5)."""
    system = two_blocks.scene(COMM, friction=friction, integration="surface")
    run = nts.simulate(system, CONTACT_RULES["energy-momentum"], dt=2e-3, t_end=0.12)
    found = two_blocks.figures(run)
    assert found["status"] == "completed" and found["ledger"] < 1e-12
    assert max(found["linear_momentum"], found["angular_momentum"]) < 1e-13
    energy = run.balance["energy"][0]
    dissipation = run.balance["friction_dissipation"][-1] / energy
    assert abs(dissipation - rubbed) < 5e-7
    assert abs(found["energy_lost"] - dissipation - 0.0498) < 5e-5
    assert found["max_active"] == 25 and found["min_gap"] > -1e-12


def handed(integration, swap):
    """Momentum along x that B1's first block has after 0.12 s, and the energy that is lost."""
    system = two_blocks.scene(COMM, integration=integration)
    pair = system.contacts[0]
    if swap:
        pair = nts.ContactPair(pair.master, pair.slave, integration=integration)
    system = nts.System(system.bodies, contacts=[pair])
    run = nts.simulate(system, CONTACT_RULES["energy-momentum"], dt=2e-3, t_end=0.12)
    body, energy = system.bodies[0], run.balance["energy"]
    left = body.linear_momentum(body.inertia(run.state.v[0]))[0]
    return COMM.allreduce(left), 1 - energy[-1] / energy[0]


@pytest.mark.slow
def test_either_side_may_be_the_slave():
    """Of 2000 kg m/s the first block keeps the same part whichever is the slave, and the energy.

    Of nodes against facets the coarse slave errs by little more than a per cent of the momentum.
    """
    fine, coarse = (handed("surface", swap) for swap in (False, True))
    assert abs(fine[0] - coarse[0]) < 1.0
    # Theory section 17.5.
    assert abs(fine[1] - 0.0498) < 5e-5 and abs(coarse[1] - 0.0490) < 5e-5
    one, two = (handed("nodes", swap) for swap in (False, True))
    # Without corners of the master, which hold where the slave is the coarse one, -308.
    assert max(abs(left - fine[0]) for left, _ in (one, two)) < 30.0


@pytest.mark.mpi
@pytest.mark.slow
def test_an_impact_gives_its_energy_back():
    system = rubbing_blocks(0.0, integration="surface")
    rule = CONTACT_RULES["energy-momentum"]
    run = nts.simulate(system, rule, dt=2e-3, t_end=0.1, newton=TIGHT, impact="restored")
    table, energy = run.balance, run.balance["energy"]
    assert run.status == "completed" and table["contact_defect"][-1] > 0.05 * energy[0]
    # What nodes that stay lose or gain as their points change is no impact.
    assert np.abs(energy / energy[0] - 1).max() < 1e-4
    assert np.abs(table["ledger_residual"]).max() < 1e-12 * energy[0]
    for name in ("linear_momentum", "angular_momentum"):
        assert drift(table, name) < 1e-12
    # What the contact's forces and their moments have done is the change of the slave's momenta.
    body, momenta = system.bodies[0], []
    for state in (system.initial_state(), run.state):
        p = body.inertia(state.v[0])
        own = np.stack([body.linear_momentum(p), body.angular_momentum(state.u[0], p)])
        momenta.append(COMM.allreduce(own))
    h = np.diff(table["time"])
    done = [(h[:, None] * a[1:, 0]).sum(axis=0) for a in (run.contact_forces, run.contact_moments)]
    assert np.abs(momenta[1] - momenta[0] - done).max() < 1e-12 * np.abs(momenta[0]).max()


# ---- what is refused
def test_what_it_does_not_know():
    def pair(master=None, slave=None, **options):
        slave = slave or nts.Continuum(box(cells=4), RUBBER, density=1.0, name="slave")
        return nts.ContactPair(slave.surface(at(2, 0.0), **options), master, integration="surface")

    low = box((0, 0, -1), (1, 1, 0))
    rigid = nts.RigidBody(low, density=1.0, name="rigid")
    soft = nts.Continuum(low, RUBBER, density=1.0, name="soft")
    below = at(2, 0.0)
    with pytest.raises(ValueError, match="'rigid' is rigid, and nothing yields"):
        pair(nts.Plane((0, 0, 0), (0, 0, 1)), rigid)
    with pytest.raises(ValueError, match="smoothed.*leave smoothing out"):
        pair(soft.surface(below, smoothing=True))
    with pytest.raises(ValueError, match="no mass"):
        pair(soft.surface(below), mass="redistributed")
    with pytest.raises(ValueError, match="both 'other' and 'rigid' are rigid"):
        pair(rigid.surface(below), nts.RigidBody(box(), density=1.0, name="other"))
    with pytest.raises(ValueError, match="integration='faces': choose one of 'nodes', 'surface'"):
        nts.ContactPair(soft.surface(below), rigid.surface(below), integration="faces")
