"""Bad input raises on every rank, before any work, and names the argument, its value and a remedy.

Serial tests show the message; on two ranks the wrong data sit on one rank only where they can.
"""

import math
import re
from functools import partial
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import (
    CellType,
    create_unit_cube,
    create_unit_square,
    locate_entities_boundary,
    meshtags,
)
from scenes import CELLS, RUBBER, bottom, box, top

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.output import BalanceCSV, Fields
from dolfinx_nts.output.pictures import picture

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.mpi


def continuum(mesh=None, material=RUBBER, density=1e3, **options):
    return nts.Continuum(mesh or box(), material, density=density, **options)


class Meshed(nts.Body):
    mesh = "a mesh"


def stacked(gap=0.1, **upper):
    """A column on a column, their facing surfaces in contact."""
    low = continuum(name="low")
    high = continuum(box((0.2, 0.2, 1 + gap), (0.8, 0.8, 2 + gap)), name="high", **upper)
    pair = nts.ContactPair(high.surface(lambda x: x[2] < 1 + gap + 1e-9), low.surface(top))
    return low, high, pair


def run(system=None, integrator=None, **options):
    options = {"dt": 1e-3, "t_end": 1e-3} | options
    return nts.simulate(
        system or nts.System([continuum()]), integrator or nts.EnergyMomentum(), **options
    )


def facet_tags(mesh, dim=2, where=top, value=3):
    mesh.topology.create_connectivity(dim, 3)
    found = np.sort(locate_entities_boundary(mesh, dim, where)).astype(np.int32)
    return meshtags(mesh, dim, found, np.full(len(found), value, np.int32))


def interior_tags(mesh):
    """The facets at mid-height of the unit cube, none of them on the boundary, tagged 3."""
    mesh.topology.create_entities(2)
    mesh.topology.create_connectivity(2, 3)
    from dolfinx.mesh import locate_entities

    found = np.sort(locate_entities(mesh, 2, lambda x: np.isclose(x[2], 0.5))).astype(np.int32)
    return meshtags(mesh, 2, found, np.full(len(found), 3, np.int32))


def raises(kind, pattern, action):
    """The action raises on this rank, with a one-sentence message that matches the pattern."""
    with pytest.raises(kind) as caught:
        action()
    message = str(caught.value)
    assert re.search(pattern, message), message
    assert "\n" not in message and len(message) < 400, message
    assert len(set(COMM.allgather(type(caught.value).__name__))) == 1
    return message


# ---- numbers
@pytest.mark.parametrize("density", [0.0, -1.0, np.nan, np.inf, "heavy", None])
def test_density(density):
    pattern = rf"^density={re.escape(repr(density))}: must be positive and finite \[kg/m\^3\]"
    raises(ValueError, pattern, lambda: continuum(density=density))


@pytest.mark.parametrize("dt", [0.0, -1e-3, np.nan, np.inf, "1"])
@pytest.mark.parametrize("name", ["dt", "t_end"])
def test_time(name, dt):
    pattern = rf"^{name}={re.escape(repr(dt))}: must be positive and finite \[s\]"
    raises(ValueError, pattern, lambda: run(**{name: dt}))


def test_step_of_the_stepper():
    stepper = nts.Stepper(nts.System([continuum()]), nts.Midpoint())
    raises(ValueError, r"^dt=-1: must be positive", lambda: stepper.advance(-1))
    stepper.close()


@pytest.mark.parametrize("material", [nts.NeoHookean, nts.StVenantKirchhoff])
def test_stiffness(material):
    for young in (0.0, -1e6, np.nan, "soft"):
        pattern = rf"^young={re.escape(repr(young))}: must be positive and finite \[Pa\]"
        raises(ValueError, pattern, lambda young=young: material(young=young, poisson=0.3))
    for poisson in (0.5, 0.7, -1.0, np.nan):
        pattern = rf"^poisson={re.escape(repr(poisson))}: must lie in \(-1, 0.5\)"
        raises(ValueError, pattern, lambda nu=poisson: material(young=1.0, poisson=nu))


def test_mooney_rivlin():
    raises(ValueError, r"^c=0: must be positive", lambda: nts.MooneyRivlin(a=1, b=1, c=0))
    raises(ValueError, r"^a \+ b=-1: must be positive", lambda: nts.MooneyRivlin(a=1, b=-2, c=1))


@pytest.mark.parametrize("gravity", [(0, 0), 9.81, (0, 0, np.nan), "down", None])
def test_gravity(gravity):
    pattern = rf"^gravity={re.escape(repr(gravity))}: pass three finite components \[m/s\^2\]"
    raises(ValueError, pattern, lambda: nts.System([continuum()], gravity=gravity))


@pytest.mark.parametrize("name", ["degree", "quadrature_degree"])
def test_degree(name):
    pattern = rf"^{name}=0: must be a positive integer"
    raises(ValueError, pattern, lambda: continuum(**{name: 0}))


NO_NUMBERS = ("1", None, np.nan, True, [], 1j, np.array([1.0, 2.0]), len)


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("young", lambda bad: nts.NeoHookean(young=bad, poisson=0.3)),
        ("poisson", lambda bad: nts.NeoHookean(young=1.0, poisson=bad)),
        ("poisson", lambda bad: nts.StVenantKirchhoff(young=1.0, poisson=bad)),
        ("a", lambda bad: nts.MooneyRivlin(a=bad, b=1.0, c=1.0)),
        ("b", lambda bad: nts.MooneyRivlin(a=1.0, b=bad, c=1.0)),
        ("c", lambda bad: nts.MooneyRivlin(a=1.0, b=1.0, c=bad)),
        ("rtol", lambda bad: nts.Newton(rtol=bad)),
        ("max_iterations", lambda bad: nts.Newton(max_iterations=bad)),
        ("max_retries", lambda bad: nts.Newton(max_retries=bad)),
        ("tolerance", lambda bad: nts.Adapt(tolerance=bad)),
        ("shortest", lambda bad: nts.Adapt(shortest=bad)),
        ("quadrature_points", lambda bad: nts.EnergyMomentum(quadrature_points=bad)),
        ("friction", lambda bad: nts.ContactPair(None, None, friction=bad)),
        ("radius", lambda bad: nts.Sphere((0, 0, 0), radius=bad)),
        ("density", lambda bad: continuum("no mesh", density=bad)),
        ("degree", lambda bad: continuum("no mesh", degree="" if bad is None else bad)),
        ("dt", lambda bad: nts.simulate(None, None, dt=bad, t_end=1.0)),
        (
            "stabilization",
            lambda bad: nts.equilibrium(None, stabilization="" if bad is None else bad),
        ),
        ("load_steps", lambda bad: nts.equilibrium(None, load_steps=bad)),
        ("interval", lambda bad: Fields("folder", interval="" if bad is None else bad)),
        ("width", lambda bad: picture([Meshed()], "p.png", width=bad)),
        ("accuracy", lambda bad: run(accuracy="" if bad is None else bad)),
        ("components", lambda bad: nts.Dirichlet(top, components=(bad,))),
    ],
)
def test_what_is_no_number(name, action):
    """Nor any other of a few names: it is text, a truth value, NaN, complex or an array."""
    for bad in NO_NUMBERS:
        if name == "load_steps" and isinstance(bad, np.ndarray):
            bad = bad[::-1]
        raises((TypeError, ValueError), rf"^{name}=", lambda bad=bad: action(bad))


@pytest.mark.parametrize(
    ("pattern", "action"),
    [
        (
            r"^gravity=\('0', '0', '1'\): pass three",
            lambda: nts.System([continuum()], gravity=tuple("001")),
        ),
        (
            r"^load_steps=\['1', '2'\]: pass a number",
            lambda: nts.equilibrium(0, load_steps=["1", "2"]),
        ),
        (r"^progress='no': pass True or False", lambda: run(progress="no")),
        (r"^progress=1: pass True or False", lambda: nts.equilibrium(None, progress=1)),
        (r"^folder=None: pass a path, e.g.", lambda: Fields(None)),
        (r"^path=3: pass a path, e.g.", lambda: BalanceCSV(3)),
        (r"^path=3: pass a path, e.g.", lambda: nts.Solution(None).plot(3)),
        (r"^scene=3: pass a sequence of", lambda: picture(3, "p.png")),
        (r"^colour=\[\]: choose one", lambda: picture([continuum()], "p.png", colour=[])),
        (r"^limits=\[\]: pass two", lambda: picture([continuum()], "p.png", limits=[])),
        (r"^mesh=None: pass a dolfinx mesh", lambda: nts.bodies_from_tags(None, None)),
        (r"^names='a': pass a dict", lambda: nts.bodies_from_tags(box(), None, names="a")),
        (r"^surfaces=3: pass a dict", lambda: nts.bodies_from_tags(box(), None, surfaces=3)),
        (r"^comm=None: pass an MPI comm", lambda: nts.bodies_from_gmsh("a.msh", None)),
    ],
)
def test_what_is_of_another_kind(pattern, action):
    raises((TypeError, ValueError), pattern, action)


# ---- materials
def test_material_that_is_no_function():
    raises(TypeError, r"^material=1000000.0: pass a callable C -> W", lambda: continuum(None, 1e6))


def test_material_that_is_no_scalar():
    pattern = r"^material=<function.* of 'body': W\(C\) has shape \(3, 3\); return a UFL scalar"
    raises(TypeError, pattern, lambda: continuum(None, lambda c: c))
    pattern = r"^material=<function.*raised .*return a UFL scalar"
    raises(TypeError, pattern, lambda: continuum(None, lambda c: None))


@pytest.mark.parametrize("function", [math.log, np.log])
def test_material_of_functions_of_numbers(function):
    pattern = r"^material=<function.*raised TypeError.*; return a UFL scalar, made of functions of"
    raises(TypeError, pattern, lambda: continuum(None, lambda c: function(ufl.det(c))))


def test_extra_form_of_functions_of_numbers(caplog):
    """UFL of DOLFINx 0.5 tries without an end to make a number of the time."""

    def load(u, v, w, t):
        return math.sin(t) * w[2] * ufl.ds

    pattern = r"^extra_form=<function.*Constant has no value yet: take ufl.sin.*return a UFL form"
    raises(TypeError, pattern, lambda: continuum(extra_form=load))
    assert not caplog.records


def test_material_that_raises():
    def broken(c):
        raise RuntimeError("no such invariant")

    pattern = r"^material=<function.*raised RuntimeError\('no such invariant'\); return"
    raises(TypeError, pattern, lambda: continuum(None, broken))


def test_material_that_raises_on_one_rank():
    def picky(c):
        if COMM.rank == COMM.size - 1:
            raise KeyError("table")
        return ufl.tr(c)

    raises(TypeError, r"W\(C\) raised KeyError\('table'\)", lambda: continuum(None, picky))


def of_another_mesh(kind):
    """A UFL scalar that lives on another mesh than the bodies."""
    other = box()
    return {
        "function": lambda: fem.Function(compat.function_space(other, "DG", 0), name="stiffness"),
        "constant": lambda: fem.Constant(other, 1.0),
        "coordinate": lambda: ufl.SpatialCoordinate(other)[0],
    }[kind]()


@pytest.mark.parametrize("kind", ["function", "constant", "coordinate"])
def test_coefficients_of_another_mesh(kind):
    other = of_another_mesh(kind)
    found = r".* of another mesh; make it on the mesh of the body$"
    pattern = r"^material=<function .* of 'body': W\(C\) contains " + found
    raises(TypeError, pattern, lambda: continuum(None, lambda c: other * ufl.tr(c)))
    mesh = box()
    dx = ufl.Measure("dx", mesh)
    pattern = r"^extra_form=<function .* of 'body': contains " + found
    extra = {"extra_form": lambda u, v, w, t: other * ufl.inner(v, w) * dx}
    raises(TypeError, pattern, lambda: continuum(mesh, **extra))


def test_a_number_in_a_material_that_is_none():
    pattern = r"^material=<function .*: W\(C\) contains the number nan; check it for NaN"
    raises(TypeError, pattern, lambda: continuum(None, lambda c: np.nan * ufl.tr(c)))


@pytest.mark.parametrize(
    ("extra_form", "problem"),
    [
        (lambda u, v, w, t: 3.0, r"returned an object of type float; return a UFL form like"),
        (lambda u, v, w, t: ufl.inner(v, w), r"returned an object of type \w+; return a UFL form"),
        (lambda u, v, w, t: None, r"returned an object of type NoneType; return a UFL form"),
        (lambda u, v, w, t: ufl.inner(u, v) * ufl.dx, r"is not linear in the test function w"),
        (lambda u, v, w, t: 0 * ufl.inner(v, w) * ufl.dx, r"raised|is not linear in the test"),
        (lambda u, v, w, t: u.x, r"raised AttributeError.*; return a UFL form"),
        (lambda u, w: ufl.inner(u, w) * ufl.dx, r"raised TypeError.*; return a UFL form"),
        (lambda *_: {}["drag"] if COMM.rank == COMM.size - 1 else None, "KeyError|NoneType"),
    ],
)
def test_extra_form(extra_form, problem):
    pattern = rf"^extra_form=<function .* of 'body': .*({problem})"
    raises(TypeError, pattern, lambda: continuum(extra_form=extra_form))
    raises(TypeError, r"^extra_form=3.0: pass a callable", lambda: continuum(extra_form=3.0))


@pytest.mark.parametrize("make", [continuum, partial(nts.Plane, (0, 0, 0), (0, 0, 1))])
def test_name(make):
    for name in (3, None, b"left"):
        pattern = rf"^name={name!r}: pass text, e.g. name='block'"
        raises(TypeError, pattern, lambda name=name: make(name=name))
    raises(ValueError, r"^name=' ': is empty; pass e.g. name='block'", lambda: make(name=" "))


# ---- velocity, loads, conditions
@pytest.mark.parametrize("velocity", [(1, 2), 3.0, (1, np.nan, 0), (1, 2, "x"), np.zeros((3, 3))])
def test_velocity(velocity):
    pattern = r"(?s)^velocity=.*: pass three finite components \[m/s\], or a callable"
    with pytest.raises(ValueError, match=pattern):
        continuum(velocity=velocity)


def test_velocity_of_wrong_shape():
    pattern = r"^velocity of 'body'=<function.*returned shape \(2, \d+\).*return shape \(3, \d+\)"
    raises(ValueError, pattern, lambda: continuum(velocity=lambda x: x[:2]))


def test_velocity_not_finite_on_one_rank():
    def corner(x):
        v = np.zeros_like(x)
        v[1, (np.abs(x - 1.0) < 1e-9).all(axis=0)] = np.nan
        return v

    pattern = r"^velocity of 'body'=<function.*not finite at x=\[1.0.*\]; check it for NaN"
    raises(ValueError, pattern, lambda: continuum(velocity=corner))


def test_velocity_that_raises_on_one_rank():
    def picky(x):
        if COMM.rank == COMM.size - 1:
            raise KeyError("table")
        return 0 * x

    pattern = r"^velocity of 'body'=.*raised KeyError\('table'\).*correct it"
    raises(ValueError, pattern, lambda: continuum(velocity=picky))


def test_loads():
    pattern = r"^Traction.value=\(1.0, 0.0\): pass three finite components \[Pa\], or a function"
    raises(ValueError, pattern, lambda: nts.Traction(top, (1.0, 0.0)))
    pattern = r"^traction=Traction\(.*: pass a sequence of Traction"
    raises(TypeError, pattern, lambda: continuum(traction=nts.Traction(top, (1, 0, 0))))
    pattern = r"^traction\[0\]='push': pass a sequence of Traction"
    raises(TypeError, pattern, lambda: continuum(traction=["push"]))
    pattern = r"^body_force of 'body' at t=0.0: returned 4.0; pass three finite components \[N/m\^"
    raises(ValueError, pattern, lambda: continuum(body_force=lambda t: 4.0))
    pattern = (
        r"^Traction.where of traction\[1\] of 'body': selects no exterior facet; check the marker"
    )
    raises(
        ValueError,
        pattern,
        lambda: continuum(
            traction=[nts.Traction(top, (1, 0, 0)), nts.Traction(lambda x: x[0] > 9, (1, 0, 0))]
        ),
    )


def test_tractions_overlap_on_one_rank():
    def corner(x):
        return top(x) & (x[0] < 0.5 + 1e-9) & (x[1] < 0.5 + 1e-9)

    loads = [nts.Traction(top, (1, 0, 0)), nts.Traction(corner, (0, 1, 0))]
    pattern = r"^traction of 'body': 1 facets carry two loads; add their values up in one of them"
    raises(ValueError, pattern, lambda: continuum(traction=loads))


@pytest.mark.fast_on_ranks()
def test_an_option_of_an_object_that_is_made_cannot_be_set():
    """Whoever sets one in mid run would see no difference: most are read only once."""
    cube = nts.Continuum(box(), nts.NeoHookean(1e6, 0.3), density=1e3, name="cube")
    stone = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="stone")
    spring = nts.Spring(stone, None, ((0, 0, 0), (0, 0, 1)), stiffness=1e3, name="coil")
    floor = nts.Plane((0, 0, -1), (0, 0, 1))
    pair = nts.ContactPair(cube.surface(lambda x: x[2] < 1e-9), floor, friction=0.3)
    system = nts.System([cube, stone], contacts=[pair], joints=[spring], gravity=(0, 0, -9.81))
    options = [
        (spring, "stiffness", 2e3), (cube, "density", 2e3), (cube, "material", None),
        (stone, "force", (0, 0, 1)), (pair, "friction", 0.5), (system, "gravity", (0, 0, 0)),
    ]  # fmt: skip
    for item, option, value in options:
        with pytest.raises(AttributeError, match=f"^{option}=.*made with another.*make a new one"):
            setattr(item, option, value)
    with pytest.raises(AttributeError, match="Spring 'coil' has been"):
        spring.stiffness = 2e3
    with pytest.raises(ValueError, match="read-only"):
        system.gravity[2] = -1.62


@pytest.mark.parametrize("components", [(3,), (), 0, ("x",)])
def test_components_of_a_condition(components):
    pattern = rf"^components={re.escape(repr(components))}: pass a tuple of some of 0, 1, 2"
    raises(ValueError, pattern, lambda: nts.Dirichlet(top, components=components))


def test_conditions():
    pattern = r"^bcs\[0\]=.*: pass a sequence of Dirichlet"
    raises(TypeError, pattern, lambda: continuum(bcs=[top]))
    raises(TypeError, r"^bcs=Dirichlet.*sequence", lambda: continuum(bcs=nts.Dirichlet(top)))
    pattern = r"^Dirichlet.value=.*: pass three finite components \[m\], or a function of time"
    for value in ((0, 0), 0.0, None, (0, 0, np.nan), "fixed"):
        raises(ValueError, pattern, lambda v=value: nts.Dirichlet(top, v))
    pattern = r"^Dirichlet.value of bcs.0. of 'body' at t=0.0: returned \(0, nan, 0\); pass"
    moving = nts.Dirichlet(top, lambda t: (0, np.nan, 0))
    raises(ValueError, pattern, lambda: continuum(bcs=[moving]))
    pattern = r"^Dirichlet.where of bcs\[0\] of 'body'=5: pass a function of x"
    raises(TypeError, pattern, lambda: continuum(bcs=[nts.Dirichlet(5)]))


# ---- meshes
def test_mesh_in_two_dimensions():
    pattern = r"^mesh of 'body': triangle in 2D; pass 3D hexahedra or tetrahedra"
    raises(ValueError, pattern, lambda: continuum(create_unit_square(COMM, 2, 2)))


def test_mesh_that_is_no_mesh():
    raises(TypeError, r"^mesh='cube': pass a dolfinx mesh", lambda: continuum("cube"))


def test_mesh_with_nan_on_one_rank():
    mesh = create_unit_cube(COMM, 2, 2, 2, CellType.hexahedron)
    corner = np.flatnonzero((np.abs(mesh.geometry.x - 1) < 1e-9).all(axis=1))
    mesh.geometry.x[corner, 1] = np.nan
    pattern = r"^mesh of 'body': 1 nodes are not finite.*nan.*check the coordinates for NaN"
    raises(ValueError, pattern, lambda: continuum(mesh))


@pytest.mark.parametrize("kind", CELLS)
def test_inverted_cell_on_one_rank(kind):
    """A corner node moved through its cells, which no other rank may hold."""
    mesh = box(cell=CELLS[kind])
    corner = np.flatnonzero((np.abs(mesh.geometry.x - 1) < 1e-9).all(axis=1))
    mesh.geometry.x[corner] = -0.9
    pattern = r"^mesh of 'body': .*inverted or (flat|overlapping) cells.*repair the mesh"
    raises(ValueError, pattern, lambda: continuum(mesh))


@pytest.mark.parametrize("kind", CELLS)
def test_cells_turned_inside_out_as_a_whole(kind):
    mesh = box(cells=(1, 1, 3), cell=CELLS[kind])
    middle = np.abs(mesh.geometry.x[:, 2] - 1 / 3) < 1e-9
    mesh.geometry.x[middle, 2] = 0.9
    pattern = r"overlapping cells, whose volumes add up to .* encloses .*; repair the mesh"
    raises(ValueError, pattern, lambda: continuum(mesh))


def test_flat_cell():
    mesh = box(cells=(1, 1, 3))
    mesh.geometry.x[np.abs(mesh.geometry.x[:, 2] - 1 / 3) < 1e-9, 2] = 0.0
    pattern = r"^mesh of 'body': 1 inverted or flat cells, e.g. the one at x=\[0.5, 0.5, 0"
    raises(ValueError, pattern, lambda: continuum(mesh))


def test_distorted_mesh_is_no_error():
    """Curved faces: the volumes of trilinear cells and of what their faces enclose are exact."""
    mesh = box((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))
    x = mesh.geometry.x
    x += 0.08 * np.sin(7 * x[:, [1, 2, 0]]) * np.cos(5 * x[:, [2, 0, 1]])
    assert continuum(mesh).num_owned >= 0


# ---- surfaces
def test_empty_marker():
    pattern = r"^marker of a surface of 'body': selects no exterior facet; check the marker's tol"
    raises(ValueError, pattern, lambda: continuum().surface(lambda x: x[0] > 2))
    body = continuum()
    pattern = r"^marker of a surface of 'body' \(tag 4\): selects no exterior facet; .* or the tag"
    raises(ValueError, pattern, lambda: body.surface(facet_tags(body.mesh), 4))


def test_marker_of_wrong_kind():
    body = continuum()
    pattern = r"^marker of a surface of 'body'=7: pass a function of x .*, or meshtags and a tag"
    raises(TypeError, pattern, lambda: body.surface(7))
    tags = facet_tags(body.mesh)
    raises(TypeError, r"pass a function of x .*, or meshtags and a tag", lambda: body.surface(tags))
    pattern = r"^marker of a surface of 'body' \(tag '3'\): pass a whole number as the tag"
    raises(TypeError, pattern, lambda: body.surface(tags, "3"))
    pattern = r"pass facet meshtags \(dimension 2\), not cell or edge tags"
    body.mesh.topology.create_entities(1)
    edges = facet_tags(body.mesh, dim=1)
    raises(ValueError, pattern, lambda: body.surface(edges, 3))
    raises(TypeError, "a function of x takes no tag, but 3 is given", lambda: body.surface(top, 3))
    pattern = r"meshtags and a tag as two arguments, e.g. surface\(\*part.where\('top'\)\)"
    raises(TypeError, pattern, lambda: body.surface((tags, 3)))
    pattern = r"meshtags and a tag, which part.where\('top'\) has of a surface with this name"
    raises(TypeError, pattern, lambda: body.surface("top"))


def test_tags_of_another_mesh():
    """Their facets have the numbers of other ones in this body."""
    body, tags = continuum(), facet_tags(box(cells=(1, 1, 3)))
    pattern = r"^marker of a surface of 'body' \(tag 3\): these meshtags are of another mesh"
    raises(ValueError, pattern, lambda: body.surface(tags, 3))
    pattern = r"^Dirichlet.where of bcs\[0\] of 'body' \(tag 3\): these meshtags are of another"
    raises(ValueError, pattern, lambda: continuum(bcs=[nts.Dirichlet((tags, 3))]))


def test_tags_without_their_tag():
    tags = facet_tags(box())
    for kind, value in ((nts.Dirichlet, 3), (nts.Traction, 3)):
        pattern = rf"^{kind.__name__}.where=.*: is meshtags alone; pass the pair .* without a star"
        raises(TypeError, pattern, partial(kind, tags, value))


def test_stress_of_a_rigid_body(tmp_path):
    rigid = nts.RigidBody(box(), density=1.0, name="hard")
    for stress in (nts.von_mises, nts.cauchy_stress):
        raises(TypeError, r"^body='hard': has no material W\(C\)", partial(stress, rigid))
    pattern = r"^colour='stress': none of \['hard'\] has a material; colour by 'speed'"
    raises(ValueError, pattern, lambda: picture([rigid], tmp_path / "p.png", colour="stress"))


def test_marker_of_wrong_shape():
    pattern = r"returned shape \(3, \d+\) for x of shape \(3, \d+\); return shape \(\d+,\)"
    raises(ValueError, pattern, lambda: continuum().surface(lambda x: x > 0))


@pytest.mark.parametrize(
    "marker",
    [lambda x: x[2], lambda x: 1 - np.round(x[2]).astype(int), lambda x: x[2].astype(str)],
    ids=["float", "int", "text"],
)
def test_marker_that_returns_no_truth_values(marker):
    """Taken for truth, these would select what is not zero, nearly everything."""
    returned = r"=<function .*>: returned [\w<>]+ values; return truth values, e.g. x\[0\] < 1e-9$"
    pattern = r"^marker of a surface of 'body'" + returned
    raises(ValueError, pattern, lambda: continuum().surface(marker))
    pattern = r"^Dirichlet.where of bcs\[1\] of 'body'" + returned
    held = [nts.Dirichlet(top), nts.Dirichlet(marker)]
    raises(ValueError, pattern, lambda: continuum(bcs=held))
    pattern = r"^Traction.where of traction\[0\] of 'body'" + returned
    raises(ValueError, pattern, lambda: continuum(traction=[nts.Traction(marker, (1, 0, 0))]))


def test_marker_that_returns_numbers_on_one_rank():
    def mixed(x):
        return top(x).astype(float) if COMM.rank == COMM.size - 1 else top(x)

    raises(ValueError, r"returned float64 values; return truth", lambda: continuum().surface(mixed))


def test_marker_that_returns_a_list_of_truth_values():
    """Where a rank has no points the list is empty, and of no kind at all."""
    column = continuum(box(cells=(1, 1, 1)))
    surface = column.surface(lambda x: [bool(z > 0.5) for z in x[2]])
    assert len(surface.facets) == 1


def test_velocity_that_is_no_number():
    pattern = r"^velocity of 'body'=<function.*returned <U\d+ values; return real numbers"
    raises(ValueError, pattern, lambda: continuum(velocity=lambda x: x.astype(str)))
    cell = box(cells=(1, 1, 1))  # one rank has no nodes
    raises(ValueError, pattern, lambda: continuum(cell, velocity=lambda x: x.astype(str)))
    pattern = r"^velocity of 'body'=<function.*returned complex128 values; return real numbers"
    raises(ValueError, pattern, lambda: continuum(velocity=lambda x: 1j * x))


def test_marker_that_raises_on_one_rank():
    def picky(x):
        if COMM.rank == COMM.size - 1:
            raise ZeroDivisionError
        return top(x)

    raises(ValueError, r"raised ZeroDivisionError", lambda: continuum().surface(picky))


def test_interior_facets():
    body = continuum()
    pattern = r"\(tag 3\): 4 interior facets selected; a contact surface must lie on the boundary"
    raises(ValueError, pattern, lambda: body.surface(interior_tags(body.mesh), 3))


def test_facets_are_oriented_outward_whatever_their_numbering():
    body = continuum(box(cell=CELLS["tetrahedron"]))
    surface = body.surface(lambda x: np.ones_like(x[0], dtype=bool))
    a, b, c = surface.reference[surface.facets].transpose(1, 0, 2)
    outward = np.einsum("ni,ni->n", np.cross(b - a, c - a), (a + b + c) / 3 - 0.5)
    assert (outward > 0).all()


def test_surface_of_a_cubic_body():
    body = continuum(box(cells=(1, 1, 1)), degree=3)
    pattern = r"^degree=3 of body 'body': surfaces, of contacts and of ties, need degree 1 or 2"
    raises(ValueError, pattern, lambda: body.surface(top))


def test_smoothing():
    pattern = r"^smoothing='yes': pass True or False"
    raises(TypeError, pattern, lambda: continuum().surface(top, smoothing="yes"))


# ---- contacts and systems
def test_motion_of_a_name():
    raises(TypeError, r"^body='left': pass a body, e.g. run", lambda: nts.motion_of("left"))


def test_slave_is_master():
    body = continuum()
    surface, other = body.surface(top), body.surface(lambda x: x[0] < 1e-9)
    pattern = r"^slave, master: both surfaces of 'body' share nodes; choose disjoint markers"
    raises(ValueError, pattern, lambda: nts.ContactPair(surface, surface))
    raises(ValueError, pattern, lambda: nts.ContactPair(surface, other))
    pair = nts.ContactPair(surface, body.surface(bottom))
    assert pair.name == "body-body" and repr(pair) == "<ContactPair 'body-body', slave 'body'>"
    wrong = r"^slave=<Continuum 'body'>: pass a Surface"
    raises(TypeError, wrong, lambda: nts.ContactPair(body, 0))


def test_contact_of_no_surface():
    surface = continuum().surface(top)
    pattern = r"^master='floor': pass a Surface, e.g. body.surface\(marker\)"
    raises(TypeError, pattern, lambda: nts.ContactPair(surface, "floor"))


def test_contact_of_a_body_that_is_not_in_the_system():
    low, high, pair = stacked()
    pattern = r"^contacts: the slave body 'high' is not among bodies=\['low'\]; add it"
    raises(ValueError, pattern, lambda: nts.System([low], contacts=[pair]))
    alike = stacked()[:2]
    pattern = r"^contacts: the slave body 'high' is another object than the one of that name among"
    raises(ValueError, pattern, lambda: nts.System(alike, contacts=[pair]))
    raises(TypeError, r"^contacts=<.*sequence", lambda: nts.System([low, high], contacts=pair))
    pattern = r"^contacts\[0\]='pair': pass a sequence of ContactPair"
    raises(TypeError, pattern, lambda: nts.System([low, high], contacts=["pair"]))


def test_bodies():
    raises(ValueError, r"^bodies=\[\]: pass at least one body", lambda: nts.System([]))
    mesh = box()
    raises(TypeError, r"^bodies\[0\]=.*: pass a sequence", lambda: nts.System([mesh]))
    body = continuum(mesh)
    raises(TypeError, r"^bodies=.*: pass a sequence", lambda: nts.System(body))
    pattern = r"^bodies: names \['body', 'body'\] are not unique; pass name= to each body"
    raises(ValueError, pattern, lambda: nts.System([body, continuum()]))
    twice = r"^bodies\[1\]: 'body' is given twice; drop one"
    raises(ValueError, twice, lambda: nts.System([body, body]))


@pytest.mark.skipif(COMM.size == 1, reason="one rank: all communicators are alike")
def test_bodies_on_different_communicators():
    alone = continuum(create_unit_cube(MPI.COMM_SELF, 1, 1, 1, CellType.hexahedron), name="alone")
    pattern = r"^bodies: 'alone' and 'body' live on different communicators, of 1 and \d ranks"
    raises(ValueError, pattern, lambda: nts.System([continuum(), alone]))


@pytest.mark.parametrize(
    ("gap", "size"), [(-0.05, "0.1"), (-0.3, "0.6"), (-0.6, "0.8"), (-0.9, "0.2")]
)
def test_penetration_however_deep(gap, size):
    low, high, pair = stacked(gap)
    message = raises(
        ValueError,
        rf"^contact 'high-low': 9 slave nodes start inside the master, up to {size} of a facet "
        r"\(allowed 0.01\), nodes \[.*\]; move the bodies apart",
        lambda: nts.System([low, high], contacts=[pair]),
    )
    nodes = [int(n) for n in re.search(r"nodes \[(.*)\]", message).group(1).split(",")]
    assert nodes == sorted(pair.slave.original)


def test_penetration_on_one_rank():
    """One corner of the slave surface, owned by one rank, reaches through the master."""
    mesh = box((0.2, 0.2, 1.1), (0.8, 0.8, 2.1))
    corner = np.flatnonzero((np.abs(mesh.geometry.x - [0.8, 0.8, 1.1]) < 1e-9).all(axis=1))
    mesh.geometry.x[corner, 2] = 0.95
    low, high = continuum(name="low"), continuum(mesh, name="high")
    pair = nts.ContactPair(high.surface(lambda x: x[2] < 1.1 + 1e-9), low.surface(top))
    pattern = r": 1 slave nodes start inside the master, up to 0.1 of a facet"
    raises(ValueError, pattern, lambda: nts.System([low, high], contacts=[pair]))


@pytest.mark.parametrize("gap", [-0.004, 0.0, 0.3])
def test_no_penetration(gap):
    low, high, pair = stacked(gap)
    assert nts.System([low, high], contacts=[pair]).bodies == (low, high)


def test_slaves_behind_the_master_body_are_not_inside():
    """The body the master surface belongs to counts, not the half space behind the surface."""
    low, high = continuum(name="low"), continuum(box((0.2, 0.2, -1.5), (0.8, 0.8, -0.5)), name="h")
    pair = nts.ContactPair(high.surface(lambda x: x[2] > -0.5 - 1e-9), low.surface(top))
    assert nts.System([low, high], contacts=[pair]).contacts == (pair,)


# ---- unknown options
@pytest.mark.parametrize(
    ("action", "known"),
    [
        (lambda o: continuum(**o), "density, velocity"),
        (lambda o: nts.System([continuum()], **o), "contacts, joints, gravity"),
        (lambda o: run(**o), "dt, t_end, newton"),
        (lambda o: nts.Stepper(None, None, **o), "newton, petsc_options"),
        (lambda o: nts.EnergyMomentum(**o), "stress, contact_gradient"),
        (lambda o: nts.Newton(**o), "rtol, max_iterations"),
        (lambda o: nts.NeoHookean(young=1, poisson=0, **o), "young, poisson"),
        (lambda o: nts.ContactPair(None, None, **o), "slave, master"),
        (lambda o: nts.Dirichlet(top, **o), "where, value, components"),
        (lambda o: nts.Traction(top, (0, 0, 1), **o), "where, value"),
    ],
    ids="Continuum System simulate Stepper EnergyMomentum Newton material pair bc load".split(),
)
def test_unknown_option(action, known):
    pattern = rf"^colour='red': unknown option of \w+; choose from .*{known}"
    raises(TypeError, pattern, lambda: action({"colour": "red"}))


@pytest.mark.parametrize(
    ("action", "pattern"),
    [
        (lambda: nts.Continuum(box(), RUBBER, 1e3), "density=1000.0: Continuum .*mesh, mat"),
        (lambda: nts.RigidBody(box(), 1e3), "density=1000.0: RigidBody takes no more than m"),
        (lambda: nts.System([], []), r"contacts=\[\]: System takes no more than bodies without"),
        (lambda: nts.Plane((0, 0, 0), (0, 0, 1), 3), "motion=3: Plane .*than point, normal with"),
        (lambda: nts.ContactPair(None, None, 0.3), "friction=0.3: ContactPair .*slave, master wi"),
    ],
    ids="Continuum RigidBody System Plane pair".split(),
)
def test_options_without_names(action, pattern):
    raises(TypeError, rf"^{pattern}.*pass other arguments by theirs", action)


def test_unknown_rule():
    pattern = r"^stress='gonzales': choose one of 'gonzalez', 'mean-value'"
    raises(ValueError, pattern, lambda: nts.EnergyMomentum(stress="gonzales"))
    pattern = r"^contact_gradient='none': choose one of 'mean-value', 'gonzalez'"
    raises(ValueError, pattern, lambda: nts.EnergyMomentum(contact_gradient="none"))
    pattern = r"^quadrature_points=9: choose 1 to 7"
    raises(ValueError, pattern, lambda: nts.EnergyMomentum(quadrature_points=9))


def test_newton():
    raises(TypeError, r"^newton=1e-08: pass Newton\(rtol=", lambda: run(newton=1e-8))
    raises(TypeError, r"^newton=\{\}: pass Newton", lambda: run(newton={}))
    raises(ValueError, r"^rtol=0: must lie in \(0, 1\)", lambda: nts.Newton(rtol=0))
    pattern = r"^max_iterations=0: must be at least 1"
    raises(ValueError, pattern, lambda: nts.Newton(max_iterations=0))
    raises(ValueError, r"^max_retries=-1: must not be", lambda: nts.Newton(max_retries=-1))
    pattern = r"^linear_solver='cg': choose one of 'auto', 'direct', 'krylov', 'multigrid'"
    raises(ValueError, pattern, lambda: nts.Newton(linear_solver="cg"))
    raises(TypeError, r"^reuse='no': pass True or False", lambda: nts.Newton(reuse="no"))
    raises(TypeError, r"^condense=1: pass True or False", lambda: nts.Newton(condense=1))
    pattern = r"^max_iterations=2.5: pass a whole number"
    raises(TypeError, pattern, lambda: nts.Newton(max_iterations=2.5))


def test_integrator():
    pattern = r"^integrator='midpoint': pass EnergyMomentum\(\), Midpoint\(\) or another"
    raises(TypeError, pattern, lambda: run(integrator="midpoint"))
    raises(TypeError, r"^integrator=<class.*: pass EnergyM", lambda: run(integrator=nts.Midpoint))
    raises(TypeError, r"^system=.*: pass a System\(", lambda: run(continuum()))


def test_output():
    pattern = r"^output\[0\]='fields': pass a sequence of writers of dolfinx_nts.output"
    raises(TypeError, pattern, lambda: run(output=["fields"]))
    raises(
        TypeError, r"^output=.*: pass a sequence of writers", lambda: run(output=SimpleNamespace())
    )


FIELD_SPLIT = {
    "ksp_type": "fgmres",
    "pc_type": "fieldsplit",
    "pc_fieldsplit_type": "schur",
    "pc_fieldsplit_schur_precondition": "selfp",
    "fieldsplit_bodies_ksp_type": "preonly",
    "fieldsplit_bodies_pc_type": "gamg",
    "fieldsplit_bodies_mg_levels_ksp_max_it": 3,
    "fieldsplit_constraints_ksp_type": "preonly",
    "fieldsplit_constraints_pc_type": "lu",
    "fieldsplit_constraints_pc_factor_mat_solver_type": "mumps",
}


def test_petsc_options():
    """A misspelt option or value is found before the first solve, also one that needs contact."""
    body = continuum(velocity=lambda x: 0.1 * x[[1, 2, 0]])
    system = nts.System([body])
    pattern = r"^petsc_options={'pc_type': 'magic'}: .*PC type magic.*; correct the value"
    raises(ValueError, pattern, lambda: run(system, petsc_options={"pc_type": "magic"}))
    pattern = r"^petsc_options={.*'sub_pc_type': 'magic'}: .*PC type magic.*; correct the value"
    bad = {"pc_type": "bjacobi", "sub_pc_type": "magic"}
    raises(ValueError, pattern, lambda: run(system, petsc_options=bad))
    raises(TypeError, r"^petsc_options='-help': pass a dict", lambda: run(petsc_options="-help"))
    raises(TypeError, r"^petsc_options={1: 2}: pass a dict", lambda: run(petsc_options={1: 2}))
    for name in ("snes_rtol", "snes_atol", "SNES_STOL", "snes_convergence_test"):
        pattern = rf"^petsc_options\['{name}'\]=1: each block .*; pass newton=Newton\(rtol="
        raises(ValueError, pattern, lambda name=name: run(system, petsc_options={name: 1}))
    good = {"ksp_type": "gmres", "pc_type": "bjacobi", "sub_pc_type": "ilu", "ksp_rtol": 1e-12}
    for options in (good, FIELD_SPLIT | {"snes_linesearch_type": "bt"}):
        assert run(system, petsc_options=options).status == "completed"


@pytest.mark.parametrize(
    ("name", "value", "others"),
    [
        ("ksp_tpye", "gmres", {}),
        ("snes_linesearch_tpye", "bt", {}),
        ("sub_pc_tpye", "ilu", {"pc_type": "bjacobi", "ksp_type": "gmres"}),
        ("fieldsplit_bodies_pc_tpye", "ilu", FIELD_SPLIT),
        ("fieldsplit_constraints_pc_tpye", "lu", FIELD_SPLIT),
        ("fieldsplit_constraints_pc_factor_mat_slover_type", "mumps", FIELD_SPLIT),
    ],
)
def test_misspelt_petsc_options_are_found_before_the_first_step(name, value, others):
    stepper = nts.Stepper(
        nts.System([continuum(velocity=lambda x: 0.1 * x[[1, 2, 0]])]),
        nts.EnergyMomentum(),
        petsc_options={**others, name: value},
    )
    pattern = rf"^petsc_options\['{name}'\]='{value}': not used by PETSc; correct its name or rem"
    raises(ValueError, pattern, lambda: stepper.advance(1e-3))
    assert len(stepper.solution.rows) == 1
    stepper.close()


def test_material_written_by_the_user_is_accepted():
    def energy(c):
        return 1e5 * (ufl.tr(c) - 3 - ufl.ln(ufl.det(c)))

    assert isinstance(continuum(None, energy).u, fem.Function)
