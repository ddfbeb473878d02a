"""Contact of beams and shells with everything: skins that are linear in places and directors."""

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from shells import grid, plate_nodes, surface_mesh

import dolfinx_nts as nts

EM = nts.EnergyMomentum()
FAST = (0.3, 0.1, -1.0)
MU = 0.3


def shell(z=0.0, n=6, side=1.0, scale=1.0, comm=MPI.COMM_WORLD, name="shell", **options):
    """A plate of thickness 0.05 about z, in a unit of length 1/scale m."""
    x = scale * (plate_nodes(n, n, side, side) + np.array([0, 0, z]))
    return nts.Shell(
        surface_mesh(x, grid(n, n), comm), young=1e6 / scale, poisson=0.3, thickness=0.05 * scale,
        density=1e3 / scale**3, name=name, **options,
    )  # fmt: skip


def line(start, end, n=8, comm=MPI.COMM_WORLD):
    x = np.linspace(start, end, n + 1)
    return surface_mesh(x, np.column_stack([np.arange(n), np.arange(1, n + 1)]), comm, "interval")


def beam(z, comm=MPI.COMM_WORLD, scale=1.0, **options):
    """Along x over the plate; 0.06 wide and 0.05 high."""
    s = scale
    elastic = {"young": 1e6 / s, "poisson": 0.3, "density": 1e3 / s**3}
    shape = nts.Rectangle(0.05 * s, 0.06 * s).section(**elastic)
    mesh = line((0.05 * s, 0.5 * s, z * s), (0.95 * s, 0.5 * s, z * s), comm=comm)
    return nts.Beam(mesh, shape, direction=(0, 0, 1), **options)


def box(low, high, n, rigid, scale=1.0, name="box", **options):
    ends = [scale * np.array(end) for end in (low, high)]
    mesh, density = create_box(MPI.COMM_WORLD, ends, n, CellType.hexahedron), 1e3 / scale**3
    if rigid:
        return nts.RigidBody(mesh, density=density, name=name, **options)
    rubber = nts.NeoHookean(young=1e6 / scale, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=density, name=name, **options)


def below(z, scale=1.0):
    return lambda x: x[2] < (z + 1e-9) * scale


def over(z, scale=1.0):
    return lambda x: x[2] > (z - 1e-9) * scale


def block(rigid, n=2, low=0.03, scale=1.0, **options):
    """It comes down on the top of what lies below."""
    return box((0.3, 0.3, low), (0.7, 0.7, low + 0.27), (n, n, 1), rigid, scale, **options)


def table(rigid, scale=1.0):
    return box((0, 0, 0), (1, 1, 0.2), (6, 6, 1), rigid, scale, "table")


def rod(z, scale=1.0, **options):
    s = scale
    shape = nts.Circle(0.03 * s).section(young=1e6 / s, poisson=0.3, density=1e3 / s**3)
    axis = line((0.5 * s, 0.1 * s, z * s), (0.53 * s, 0.9 * s, z * s))
    return nts.Beam(axis, shape, name="rod", **options)


def meeting(case, s=1.0):
    """Bodies, slave and master of an impact, in a unit of length 1/s m.

    No step is cut: whether one is, where many nodes stick, rounding may decide.
    """
    down, of = {"velocity": tuple(s * v for v in FAST), "scale": s}, {"scale": s}
    rigid = "rigid" in case
    match case:
        case "shell on rigid" | "shell on continuum":
            a, b = shell(**of), block(rigid, **down)
            return [a, b], a.surface(side="top"), b.surface(below(0.03, s))
        case "rigid on shell" | "continuum on shell":
            a, b = block(rigid, 3, **down), shell(**of)
            return [a, b], a.surface(below(0.03, s)), b.surface(side="top")
        case "rigid on beam" | "continuum on beam":
            a, b = block(rigid, 4, **down), beam(0.0, **of)
            return [a, b], a.surface(below(0.03, s)), b.surface()
        case "shell on shell":
            a, b = shell(**of), shell(0.06, 5, 0.9, name="upper", **down)
            return [a, b], b.surface(side="bottom"), a.surface(side="top")
        case "beam on shell":
            a, b = beam(0.0557, **down), shell(**of)
            return [a, b], a.surface(), b.surface(side="top")
        case "shell on beam":
            a, b = shell(n=12, **of), beam(0.06, **down)
            return [a, b], a.surface(side="top"), b.surface()
        case "beam on rigid" | "beam on continuum":
            a, b = beam(0.2347, **down), table(rigid, **of)
            return [a, b], a.surface(), b.surface(over(0.2, s))
        case "beam on beam":
            a, b = rod(0.06, **down), beam(0.0, **of)
            return [a, b], a.surface(), b.surface()
        case _ if "beam" not in case and "shell" not in case:
            upper, lower = (kind == "rigid" for kind in case.split(" on "))
            a, b = block(upper, 2, 0.2053, **down), table(lower, **of)
            return [a, b], a.surface(below(0.2053, s)), b.surface(over(0.2, s))
        case "shell on obstacle":
            a = shell(0.0303, **down)
            return [a], a.surface(side="bottom"), nts.Plane((0, 0, 0), (0, 0, 1))
    a = beam(0.0303, **down)
    return [a], a.surface(), nts.Plane((0, 0, 0), (0, 0, 1))


def impact(case, scale=1.0):
    """An impact in a unit of length 1/scale m."""
    bodies, slave, master = meeting(case, scale)
    contact = nts.ContactPair(slave=slave, master=master, friction=MU)
    run = nts.simulate(nts.System(bodies, contacts=[contact]), EM, dt=1e-3, t_end=0.012)
    return bodies, run


CASES = [
    "shell on rigid", "shell on continuum", "rigid on shell", "continuum on shell",
    "rigid on beam", "continuum on beam", "shell on shell", "beam on shell", "shell on beam",
    "beam on rigid", "beam on continuum", "beam on beam", "continuum on rigid",
    "continuum on continuum", "rigid on continuum", "rigid on rigid", "shell on obstacle",
    "beam on obstacle",
]  # fmt: skip


ON_RANKS = {"shell on obstacle", "shell on shell", "beam on continuum"}


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=[pytest.mark.mpi] if c in ON_RANKS else []) for c in CASES]
)
@pytest.mark.fast("shell on rigid", "shell on obstacle", "beam on beam")
@pytest.mark.fast_on_ranks()
def test_impacts_keep_the_ledger_and_the_momenta(case):
    _, run = impact(case)
    balance = run.balance
    assert run.status == "completed"
    assert balance["active"].max() > 0
    assert np.abs(balance["ledger_residual"]).max() < 1e-11 * balance["energy"][0]
    if "obstacle" not in case:
        for name in ("linear_momentum", "angular_momentum"):
            size = np.abs(balance[name]).max()
            assert np.abs(balance[name] - balance[name][0]).max() < 1e-12 * size


@pytest.mark.mpi
@pytest.mark.parametrize(
    "case", ["shell on continuum", "rigid on beam", "shell on shell", "rigid on shell"]
)
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("rigid on beam")
def test_what_is_hit_sleeps_until_then(case):
    """Beams, shells and rigid bodies, with what holds their directors; the motion is the same."""
    ends = []
    for sleep in (False, True):
        bodies, slave, master = meeting(case)
        still = nts.RigidBody(
            create_box(MPI.COMM_WORLD, [(5, 5, 5), (6, 6, 6)], [1] * 3), density=1.0, name="still"
        )
        contact = nts.ContactPair(slave, master, friction=MU)
        system = nts.System([*bodies, still], contacts=[contact])
        stepper, awake = nts.Stepper(system, EM, sleep=sleep), []
        for _ in range(12):
            stepper.advance(1e-3)
            awake.append(len(stepper.problem.awake))
        assert stepper.solution.balance["active"].max() > 0
        assert stepper.solution.balance["newton_iterations"].max() > 1
        assert (awake[0], awake[-1]) == ((1, 2) if sleep else (3, 3))
        stepper.close()
        ends.append((np.concatenate(stepper.state.u), np.concatenate(stepper.state.v)))
    for a, b in zip(*ends, strict=True):
        assert MPI.COMM_WORLD.allreduce(np.abs(a - b).max(initial=0.0)) < 1e-10


def rest(body, surface, weight, friction=0.0):
    """Height at which a body comes to rest on a plane, and the force there."""
    plane = nts.Plane((0, 0, 0), (0, 0, 1))
    system = nts.System(
        [body], contacts=[nts.ContactPair(surface, plane, friction=friction)], gravity=(0, 0, -1)
    )
    run = nts.equilibrium(system, load_steps=1)
    force = run.contact_forces[-1].reshape(-1, 3)[0, 2]
    assert run.status.startswith("completed")
    assert abs(force) == pytest.approx(weight, rel=1e-8)


@pytest.mark.mpi
def test_thickness_and_section_count():
    """A shell lies half its thickness above a plane, a beam half its height: by friction held."""
    held = [nts.Dirichlet(lambda x: x[0] > -1, components=(0, 1))]
    plate = shell(0.025, 3, bcs=held)
    rest(plate, plate.surface(side="bottom"), 1e3 * 0.05)
    assert plate.midsurface()[1][:, 2] == pytest.approx(0.025, abs=1e-4)
    bar = beam(0.025, bcs=held)
    rest(bar, bar.surface(), 1e3 * 0.05 * 0.06 * 0.9)
    assert bar.centreline()[1][:, 2] == pytest.approx(0.025, abs=1e-4)


def test_skins_are_closed_and_as_large_as_their_bodies():
    """Their fluxes are the volumes, their areas those of the boxes; all nodes count."""
    from dolfinx_nts.contact.surfaces import flux, winding

    for body, size in ((shell(), (1, 1, 0.05)), (beam(0.0), (0.9, 0.06, 0.05))):
        skin = body.boundary()
        corners = skin.reference[skin.facets]
        assert flux(corners).sum() == pytest.approx(np.prod(size), rel=1e-12)
        a, b, c = size
        assert skin.area.sum() == pytest.approx(2 * (a * b + b * c + c * a), rel=1e-12)
        assert winding(corners.mean(axis=(0, 1)), corners) == pytest.approx(1.0)
        assert (skin.boundary_edges == 0).all()
    x, _ = shell().midsurface()
    for side, z in (("top", 0.025), ("bottom", -0.025)):
        part = shell().surface(side=side)
        assert np.sort(part.reference[:, 0]) == pytest.approx(np.sort(x[:, 0]))
        assert part.reference[:, 2] == pytest.approx(z)
        assert part.area.sum() == pytest.approx(1.0)
    chosen = shell().surface(lambda x: x[0] < 0.5 + 1e-9, side="top")
    assert chosen.area.sum() == pytest.approx(0.5)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("make", "kind", "text"),
    [
        (lambda: shell().surface(side="left"), ValueError, "side='left': choose one of"),
        (lambda: shell().surface(lambda x: x[0] > 7), ValueError, "selects no facet"),
        (lambda: shell().surface("top"), TypeError, "pass a function of x"),
        (lambda: beam(0).surface(lambda x: x[0] > 7), ValueError, "selects no facet"),
        (lambda: beam(0).surface(smoothing=1), TypeError, "smoothing"),
        (lambda: nts.Beam(line((0, 0, 0), (1, 0, 0)), nts.Section(
            EA=1, GA=(1, 1), GJ=1, EI=(1, 1), rhoA=1, rhoI=(1, 1))).surface(), ValueError,
         "has no outline, so no surface; pass Section"),
        (lambda: nts.Section(EA=1, GA=(1, 1), GJ=1, EI=(1, 1), rhoA=1, rhoI=(1, 1),
                             outline=[(0, 0), (1, 0), (1, 1)]), ValueError,
         "outline=.*counter-clockwise around the axis, an even number of at least 6"),
    ],
)  # fmt: skip
def test_bad_input_is_told(make, kind, text):
    with pytest.raises(kind, match=text):
        make()


def test_both_sides_of_one_shell_are_no_contact():
    body = shell()
    with pytest.raises(ValueError, match="both surfaces of 'shell' share nodes"):
        nts.ContactPair(body.surface(side="top"), body.surface(side="bottom"))


@pytest.mark.mpi
def test_surfaces_count_as_redundant_where_contacts_use_them():
    """A shell's edge for a seam, or both sides of it that are not over each other, ask nothing."""
    body, plane = shell(n=4), nts.Plane((0, 0, -9), (0, 0, 1))

    def half(sign):
        return lambda x: sign * (x[0] - 0.5) > 1e-9

    def redundant(*contacts):
        bodies = {id(b): b for contact in contacts for b in contact.bodies}
        nts.System(list(bodies.values()), contacts=contacts)
        return contacts[0].redundant

    body.surface(side="edge")
    first = nts.ContactPair(body.surface(half(1), side="bottom"), plane)
    other = nts.ContactPair(body.surface(half(-1), side="top"), plane)
    low = shell(0.5, name="low")
    over = nts.ContactPair(low.surface(below(9), side="top"), body.surface(half(1), side="top"))
    assert not redundant(first, other)
    assert redundant(first, other, over)
    assert not redundant(first), "the contacts of another system count"
    assert redundant(nts.ContactPair(shell().surface(side="edge"), plane))
    assert redundant(nts.ContactPair(beam(0.0).surface(), plane))


@pytest.mark.mpi
@pytest.mark.parametrize("friction", [0.0, MU])
@pytest.mark.fast_on_ranks("0.3")
def test_a_shell_between_two_planes(friction):
    """Both points of a node touch, and its director cannot give way: no step needs a cut."""
    body = shell(n=2)

    def up(t):
        return 0.0, 0.0, 1e-3 * np.sin(40 * t)

    contacts = [
        nts.ContactPair(
            body.surface(side=side), nts.Plane((0, 0, z), (0, 0, -z), motion=up), friction=friction
        )
        for side, z in (("top", 0.025), ("bottom", -0.025))
    ]
    run = nts.simulate(nts.System([body], contacts=contacts), EM, dt=2e-3, t_end=0.02)
    assert run.status == "completed" and run.retries == 0 and run.balance["active"].max() > 9
    work = np.abs(run.balance["external_work"]).max()
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-10 * work
    assert np.abs(run.balance["min_gap"][1:]).max() < 1e-13 * 0.05
    middle = body.midsurface()[1][:, 2]
    assert middle == pytest.approx(up(0.02)[2], rel=1e-9)


@pytest.mark.mpi
def test_contact_fields_of_a_beam_on_a_plane():
    """Loads at nodes are sums over a section's points; of forces the largest one is told."""
    bar = beam(0.0253, velocity=(0, 0, -1))
    contact = nts.ContactPair(bar.surface(), nts.Plane((0, 0, 0), (0, 0, 1)))
    stepper = nts.Stepper(nts.System([bar], contacts=[contact]), EM)
    stepper.advance(1e-3)
    solution, own = stepper.solution, bar.space.dofmap.index_map.size_local
    fields = solution.contact_fields(bar)
    (load,), (force,), (status,) = (
        [f.x.array for name, f in fields.items() if name.startswith(kind)]
        for kind in ("contact_load", "contact_force", "contact_status")
    )
    stepper.close()
    momentum = solution.balance["linear_momentum"][:, 2]
    pushed = load.reshape(-1, 3)[:own, 2]
    assert bar.comm.allreduce(pushed.sum()) == pytest.approx((momentum[1] - momentum[0]) / 1e-3)
    assert (status[:own] == 2).all() and (pushed > 0.0).all()
    assert (force[:own] <= pushed * (1 + 1e-9)).all() and (force[:own] >= pushed / 8).all()


def sliding(comm=MPI.COMM_WORLD):
    """A beam on a plate."""
    bar = beam(0.0505, comm, velocity=(0.2, 0.0, -0.5))
    plate = shell(n=4, comm=comm)
    return nts.System([bar, plate], contacts=[
        nts.ContactPair(bar.surface(), plate.surface(side="top"), friction=MU)
    ])  # fmt: skip


def save_impacts(folder):
    """Run and save all impacts."""
    for k, case in enumerate(CASES):
        _, run = impact(case)
        assert run.status == "completed" and run.retries == 0
        run.save(Path(folder) / f"{k}.h5")


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Folder with the impacts on one rank."""
    folder = tmp_path_factory.mktemp("alone")
    save_impacts(folder)
    return folder


@pytest.mark.slow
def test_impacts_on_four_ranks(on_ranks, alone, tmp_path):
    """Places and velocities to 1e-9 of those of one rank."""
    here = [str(p) for p in Path(__file__).parents[:2]]
    code = f"import sys; sys.path[:0] = {here!r}; import test_thin_contact as t; "
    on_ranks(4, "-c", f"{code}t.save_impacts({str(tmp_path)!r})")
    for k, case in enumerate(CASES):
        one, several = (nts.load(folder / f"{k}.h5") for folder in (alone, tmp_path))
        for of in ("u", "v"):
            mine, theirs = (
                np.concatenate([body[of] for body in run.bodies.values()]) for run in (one, several)
            )
            assert np.abs(mine - theirs).max() < 1e-9 * np.abs(mine).max(), case


@pytest.mark.slow
def test_slender_beams_that_cross_between_their_nodes_are_told():
    """Two beams of four cells and 4 cm that bend as they pass through each other.

    Their width was that of the bent beams as a whole, beside which nothing was deep.
    """
    across, speed = 0.3, 3.0
    shape = nts.Circle(0.02).section(young=1e7, poisson=0.3, density=1e3)
    ends = [nts.Clamp(lambda x, end=end: np.isclose(x[0], end)) for end in (0, 1)]
    held = nts.Beam(line((0, 0, 0), (1, 0, 0), 4), shape, bcs=ends, name="held")
    axis = line((across, -0.5, 0.06), (across, 0.5, 0.06), 4)
    free = nts.Beam(axis, shape, velocity=(0, 0, -speed), name="free")
    system = nts.System([held, free], contacts=[nts.ContactPair(free.surface(), held.surface())])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=0.16 / speed + 0.06)
    # The free beam's middle node is above the place at which the axes cross.
    middle = float(free.u.x.array.reshape(-1, 3)[2, 2]) + 0.06
    at = np.argsort(held.space.tabulate_dof_coordinates()[:, 0])
    z = held.u.x.array.reshape(-1, 3)[at, 2]
    assert middle < np.interp(across, np.linspace(0, 1, 5), z)
    assert run.warnings["edge through a body"].grave
    assert run.status.startswith("completed, but")
