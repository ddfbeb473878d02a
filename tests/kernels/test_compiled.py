"""The compiled kernels against their twins in NumPy, and what is told without a compiler."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from facet_kinds import CENTRE, FLAT, KINDS
from measures import relative
from twins import laws, surface

import dolfinx_nts as nts
from dolfinx_nts.contact.contact_law import ContactLaw, Rub, Together
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.obstacle_gap import ObstacleGap
from dolfinx_nts.contact.prescribed_slip import PrescribedSlip
from dolfinx_nts.kernels import compiled, compiled_law, facets, library
from dolfinx_nts.kernels.nts_element import Gap
from dolfinx_nts.parallel import need_kernels

N = 40


def pairs(nc, friction, rule):
    """Gaps of warped facets to slaves near them, and what they are evaluated with."""
    rng = np.random.default_rng(nc)
    control = FLAT[nc] + 0.1 * rng.normal(size=(N, nc, 3))
    xi = CENTRE[nc] + 0.1 * rng.normal(size=(N, 2))
    foot, _, normal = facets.frame(control, xi)
    slave = foot + 0.05 * rng.normal(size=(N, 1)) * normal
    x0 = np.concatenate([slave[:, None], control], axis=1)
    x1 = x0 + 0.1 * rng.normal(size=x0.shape)
    measure = FacetGap(
        start=x0, xi=xi, normal=normal, length=facets.size(control), rule=rule, theta=0.5,
        condense=True,
    )  # fmt: skip
    return measure, x1, rng.normal(size=(N, 3 if friction else 1))


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("nc", KINDS)
def test_elements_are_those_of_numpy(nc, friction):
    measure, x, multiplier = pairs(nc, friction, "mean-value")
    xi = measure.projection(x)
    here, there = measure._compiled(x, xi, multiplier), measure._condensed(x, multiplier)
    for found, expected in zip(here[:3], there[:3], strict=True):
        assert relative(found, expected) < 1e-13
    assert (here[3] is None) == (there[3] is None) == (not friction)
    if friction:
        for found, expected in zip(here[3], there[3], strict=True):
            assert relative(found, expected) < 1e-13


#: Friction, and what it does.
LAWS = {
    "frictionless": (0.0, {}),
    "friction": (0.3, {}),
    "rubs hardly": (0.3, {"rubs": Rub.HARDLY}),
    "strong": (3.0, {}),
    "endless": (np.inf, {}),
}


def batches(law, *, shared, prescribed, massless):
    """Gaps to quadrilaterals in all states: off, stick and slip, with and without force."""
    friction, options = LAWS[law]
    rng = np.random.default_rng(8)
    measure, x, multiplier = pairs(4, friction, "mean-value")
    slips, before = None, None
    if friction:
        free = rng.uniform(size=(N, 3)) * (rng.uniform(size=(N, 3)) > (0.3 if prescribed else 0.0))
        slips = PrescribedSlip(
            start=measure.start, foot=measure.foot, normal=measure.normal,
            tangents=measure.tangents, free=free,
        )  # fmt: skip
    if massless:
        before = rng.normal(size=(N, 3))
        before[::5, 1:] *= 0.01
        before[::2] = np.nan
    # Prescribed slips that vanish, small and large forces, none, and gaps of rounding.
    x[::5] = measure.start[::5]
    multiplier *= 10.0 ** rng.integers(-3, 1, (N, 1))
    multiplier[::7, 0] = 0.0
    multiplier[::5, 1:] *= 0.01
    scale = rng.uniform(0.5, 2.0, N)
    obeyed = ContactLaw(
        friction=friction, yields=not shared, redundant=shared, row=15, num_normal=1, scale=scale,
        yielding=scale * rng.uniform(0.3, 1.0, N), size=measure.length, prescribed=slips,
        rounding=1e-9, force_rounding=1e-9, before=before, **options,
    )  # fmt: skip
    return measure, obeyed, x, multiplier


@pytest.mark.parametrize("massless", [False, True])
@pytest.mark.parametrize("prescribed", [False, True])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("law", LAWS)
def test_laws_are_those_of_numpy(law, shared, prescribed, massless):
    measure, obeyed, x, multiplier = batches(
        law, shared=shared, prescribed=prescribed, massless=massless
    )
    together = Together(0.7, 1e-7, 2e-7) if shared else Together(0.0, 0.0, 0.0)

    measured = measure.evaluate(x, None, multiplier)
    measured.gap[::3] = measured.residual[::3, obeyed.row] = 0.0
    measured = measured._replace(let_go=np.arange(N) % 11 == 4 if shared else None)

    def arguments():
        residual, tangent = measured.residual.copy(), measured.tangent.copy()
        found = measured._replace(residual=residual, tangent=tangent)
        return x, found, multiplier, together

    here, there = obeyed.obey(*arguments()), laws.laws(obeyed, *arguments())
    for name, expected in there._asdict().items():
        found = getattr(here, name)
        if expected.dtype == bool:
            assert (found == expected).all()
        elif expected.size:
            size = np.abs(expected).max(axis=tuple(range(1, expected.ndim)), initial=0.0)
            error = np.abs(found - expected).max(axis=tuple(range(1, expected.ndim)))
            assert (error <= 1e-13 * size).all()
    assert here.active.any() and not here.active.all()
    assert np.isfinite(here.residual).all() and np.isfinite(here.tangent).all()
    if obeyed.num_tangential and law != "rubs hardly":
        assert (here.active & here.stick).any()
        assert (here.active & ~here.stick).any() or np.isinf(obeyed.friction)


#: Width over the size of facets.
WIDTH = 0.05


@pytest.mark.parametrize("gaps", [True, False])
def test_blurred_laws_hold_where_forces_are_theirs(gaps):
    """Rows vanish for force times gap = (c width)^2 and Coulomb's bound over slip and width.

    There, where the slope of friction is no mere estimate, differences of them are the tangent.
    """
    measure, obeyed, x, multiplier = batches(
        "friction", shared=False, prescribed=False, massless=False
    )
    rng, width = np.random.default_rng(3), WIDTH
    obeyed = replace(obeyed, width=width, gap_width=width if gaps else 0.0)
    x[:, 0] = measure.start[:, 0] + 0.02 * rng.normal(size=(N, 3))
    x[:, 1:] = measure.start[:, 1:]
    # Slaves in front of their facets.
    apart = measure.evaluate(x, None, multiplier).gap
    x[:, 0] += (0.03 + np.abs(apart))[:, None] * measure.normal
    gap, slip = (getattr(measure.evaluate(x, None, multiplier), name) for name in ("gap", "slip"))
    assert gap.min() > 0.0
    press = obeyed.yielding * width**2 / gap if gaps else np.full(N, 3.0)
    low = np.einsum("nab,nb->na", slip.metric, slip.value)
    far = np.sqrt(np.einsum("na,na->n", low, slip.value) + width**2)
    given = np.column_stack([-press, 0.3 * (press / far)[:, None] * low])

    def rows(x, given):
        measured = measure.evaluate(x, None, given)
        return obeyed.obey(x, measured, given, Together(0.0, 0.0, 0.0))

    here = rows(x, given)
    first = 0 if gaps else 1
    scale = obeyed.scale[:, None]
    assert here.active.all() or gaps
    assert (np.abs(here.residual[:, 15 + first :]) / scale < 1e-13).all()
    step, way, push = 1e-6, rng.normal(size=x.shape), rng.normal(size=given.shape)
    ahead, behind = (rows(x + s * way, given + s * push).residual for s in (step, -step))
    slope = (ahead - behind)[:, 15 + first :] / (2.0 * step)
    both = np.concatenate([way.reshape(N, -1), push / scale], axis=1)
    found = np.einsum("nrz,nz->nr", here.tangent, both)[:, 15 + first :]
    assert relative(found, slope) < 1e-7


def sliding(size, share):
    """Pairs that slip by a size, with a share of Coulomb's bound as friction along the slip."""
    measure, obeyed, x, _ = batches("friction", shared=True, prescribed=False, massless=False)
    x[:] = measure.start
    rng = np.random.default_rng(4)
    x[:, 0] += size * rng.normal(size=(N, 3))
    slip = measure.evaluate(x, None, np.zeros((N, 3))).slip
    low = np.einsum("nab,nb->na", slip.metric, slip.value)
    length = np.sqrt(np.einsum("na,na->n", low, slip.value))
    press = 0.5 * obeyed.yielding
    friction = (obeyed.friction * press * share / length)[:, None] * low
    return measure, obeyed, x, np.column_stack([-press, friction]), length


def test_steep_return_maps_tell_stick_from_slip_by_the_slip():
    """A blurred law leaves sliding nodes below their bounds, and return maps let these stick."""
    below = 1.0 - 0.5e-6  # a thousand widths away from sticking
    measure, obeyed, x, given, length = sliding(1e-9, below)

    def sticks(steep):
        law = replace(obeyed, steep=steep)
        here = law.obey(x, measure.evaluate(x, None, given), given, Together(0.0, 0.0, 0.0))
        assert here.active.all()
        return here.stick

    assert sticks(0.0).all()
    bound = -obeyed.friction * given[:, 0]
    assert not sticks(bound / (10.0 * length)).any()
    assert sticks(bound / (1e7 * length)).all()


def test_rounding_of_slips_leaves_friction_as_unsure_as_said():
    """A slip that is off, across itself, turns friction: by the same as rows miss."""
    measure, obeyed, x, given, length = sliding(1e-3, 1.5)
    law, off = replace(obeyed, steep=-obeyed.friction * given[:, 0] / length), 1e-9

    def rows(measured):
        return law.obey(x, measured, given, Together(0.0, 0.0, 0.0))

    measured = [measure.evaluate(x, None, given) for _ in range(2)]
    slip = measured[1].slip
    low = np.einsum("nab,nb->na", slip.metric, slip.value)
    across = np.column_stack([-low[:, 1], low[:, 0]])
    long = np.sqrt(np.einsum("na,nab,nb->n", across, slip.metric, across))
    slip.value[:] += off * across / long[:, None]
    here, there = (rows(one) for one in measured)
    assert not here.stick.any()
    turned = (there.residual - here.residual)[:, -2:] / law.scale[:, None]
    upper = np.linalg.inv(slip.metric)
    turned = np.sqrt(np.einsum("na,nab,nb->n", turned, upper, turned))
    part = SimpleNamespace(**here._asdict())
    # Friction and trial have the slip's direction: the trial is 1.5 bounds and the slip's one.
    found = law.unsure(part, off) * (1.0 + 1.0) / (1.5 + 1.0)
    assert relative(found, turned) < 1e-5
    part.end[:], part.distance[:], part.stick[:] = 0.0, 0.0, False
    with np.errstate(all="raise"):
        assert not law.unsure(part, off).any()


def test_an_obstacle_of_the_users_own_may_have_numbers_of_any_kind():
    measure = ObstacleGap(
        obstacle=Table(), start=np.ones((3, 1, 3)), normal=np.tile([0.0, 0, 1], (3, 1)),
        length=np.ones(3), rule="direct", theta=0.5,
    )  # fmt: skip
    x, multiplier = 1.125 * measure.start, np.arange(9.0).reshape(3, 3)
    plane = replace(measure, obstacle=nts.Plane((0, 0, 0), (0, 0, 1)))
    here, there = (one.evaluate(x, None, multiplier) for one in (measure, plane))
    for found, expected in zip([*here[:3], *here[3]], [*there[:3], *there[3]], strict=True):
        assert np.abs(found - expected).max() < 1e-14
    assert here.normal.dtype == np.float64


class Table(nts.Obstacle):
    """z >= 0, told in few numbers."""

    def gap(self, x):
        """The height."""
        up, n = np.array([[0, 0, 1]]), len(x)
        return Gap(x[:, 2].astype(np.float32), np.tile(up, (n, 1, 1)), np.zeros((n, 3, 3), int))


@pytest.mark.parametrize("rule", ["mean-value", "gonzalez", "direct"])
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize(("corners", "nc"), [(4, 4), (3, 4), (4, 3), (3, 3)])
def test_points_of_a_surface_are_summed_up(corners, nc, friction, rule):
    measure, x, multiplier = pairs(nc, friction, rule)
    rng, slaves, number = np.random.default_rng(12), 9, 7
    shape, share = rng.uniform(size=(2, N, corners))
    shape /= shape.sum(axis=1, keepdims=True)
    element, slot = np.sort(rng.integers(0, number, N)), rng.integers(-1, slaves, (N, corners))
    # Some points carry nothing.
    multiplier = multiplier[:slaves]
    multiplier[:4] = 0.0
    directions = np.linalg.qr(rng.normal(size=(slaves, 3, 2)))[0].transpose(0, 2, 1)
    given = element, slot, shape, share, multiplier, directions, number
    there = surface.over_surface(measure, x, *given)
    xi, own = measure.projection(x), None
    if rule != "mean-value":
        along, _, _ = surface.middle(measure, x, xi)
        every = np.concatenate([multiplier, np.zeros((1, multiplier.shape[1]))])[slot]
        frames = np.concatenate([directions, np.zeros((1, 2, 3))])[slot, : every.shape[2] - 1]
        pull = np.einsum("nc,nck,ncki->ni", share, every[..., 1:], frames)
        of_points = np.einsum("nc,nck->nk", share, every)
        if friction:
            of_points[:, 1:] = np.einsum("nai,ni->na", along, pull)
        found = measure.evaluate(x, np.empty((N, 0)), of_points)
        own = found.residual, found.tangent, found.slip.gradient if friction else np.empty(0)
    start = measure.start, measure.normal, measure.xi, measure.length
    here = compiled.over_surface(start, (x, xi), measure.theta, compiled.Summed(*given), own)
    for found, expected in zip(here, there, strict=True):
        assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("each", [1, 3])
def test_laws_of_sums_are_those_of_numpy(each):
    rng, size, slaves = np.random.default_rng(13), 21, 5
    slot, scale = rng.integers(-1, slaves, (N, 3)), rng.uniform(1, 2, slaves)
    slopes = rng.normal(size=(slaves, each, 3 + each))
    elements = rng.integers(1, 5, slaves)
    tangent = rng.normal(size=(N, size + 3 * each, size + 3 * each))
    expected = surface.law_of_sums(slot, scale, slopes, elements, tangent)
    compiled.law_of_sums(slot, scale, slopes, elements, tangent)
    assert np.abs(tangent - expected).max() < 1e-13


def test_wrenches_are_forces_and_moments_about_the_middle():
    rng = np.random.default_rng(11)
    y, push = rng.normal(size=(2, N, 5, 3))
    places, fixed = rng.uniform(size=(N, 5)) < 0.5, rng.uniform(size=(N, 5, 3)) < 0.3
    places[:, 3] = True
    number, free = places.astype(float), np.where(fixed, 0.0, push)
    middle = np.einsum("nk,nki->ni", number, y) / number.sum(axis=1)[:, None]
    moment = np.cross(y - middle[:, None] * number[:, :, None], free).sum(axis=1)
    expected = np.column_stack([np.einsum("nk,nki->ni", number, free), moment])
    found = compiled_law.wrenches(y, push, places, fixed)
    assert np.abs(found - expected).max() < 1e-13


def test_arrays_that_may_not_be_written_or_are_not_contiguous_are_read():
    rng = np.random.default_rng(12)
    corners, points = rng.normal(size=(2 * N, 4, 3)), rng.normal(size=(3, N)).T
    expected = compiled.closest_point(points.copy(), corners[::2].copy())
    points.flags.writeable = corners.flags.writeable = False
    for found, right in zip(compiled.closest_point(points, corners[::2]), expected, strict=True):
        assert np.array_equal(found, right)


@pytest.mark.parametrize("far", [0.01, 0.3, 3.0])
@pytest.mark.parametrize("nc", KINDS)
def test_projections_are_those_of_numpy(nc, far):
    """Points beyond the centre of curvature included, for which no plain Newton step does."""
    rng = np.random.default_rng(5)
    corners = FLAT[nc] + 0.2 * rng.uniform(-1, 1, (300, nc, 3))
    points = facets.frame(corners, np.tile(CENTRE[nc], (300, 1)))[0]
    points += far * rng.uniform(-1, 1, points.shape)
    start = rng.uniform(-1, 1, (300, 2))
    found, done = compiled.project(points, corners, start)
    expected, reached = facets.project(points, corners, start)
    assert (done == reached).all() and done.mean() > 0.6
    assert np.abs(found - expected)[done].max() < 1e-12 * max(1.0, np.abs(expected[done]).max())


def test_projections_near_the_facet_need_no_numpy(monkeypatch):
    def fail(*_):
        raise AssertionError

    for nc in KINDS:
        start = np.tile(CENTRE[nc], (9, 1))
        corners = np.tile(FLAT[nc], (9, 1, 1))
        points = facets.frame(corners, start + 0.1)[0] + 0.01
        expected = facets.project(points, corners, start)[0]
        with monkeypatch.context() as patch:
            patch.setattr(facets, "project", fail)
            assert np.abs(compiled.project(points, corners, start)[0] - expected).max() < 1e-14


def test_where_there_is_no_foot_nothing_is_solved():
    measure, x, multiplier = pairs(4, 0.0, "mean-value")
    x[0, 1:] = x[0, 1]
    residual = measure.evaluate(x, None, multiplier).residual
    assert np.isnan(residual[0]).any() and np.isfinite(residual[1:]).all()


def test_without_compiler_it_is_said_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for compiler, why in (("no-such-compiler", "No such file"), ("false", "status 1")):
        monkeypatch.setenv("CC", compiler)
        with pytest.raises(library.NotMadeError, match=f"{compiler}.*ziglang") as raised:
            library.load.__wrapped__()
        assert "kernels of contact" in str(raised.value) and why in str(raised.value)


def test_without_cache_it_is_said_what_to_set(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(library.NotMadeError, match="set XDG_CACHE_HOME"):
        library.load.__wrapped__()


@pytest.mark.slow
def test_several_may_compile_at_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with ThreadPoolExecutor(4) as pool:
        libraries = list(pool.map(lambda _: library.load.__wrapped__(), range(4)))
    assert all(libraries)
    left = sorted(path.suffix for path in (tmp_path / "fenics").iterdir())
    assert left == [".lock", ".so"]


@pytest.mark.mpi
def test_what_a_rank_lacks_is_told_on_all(monkeypatch):
    comm, last = MPI.COMM_WORLD, MPI.COMM_WORLD.size - 1
    need_kernels(comm)

    def fail():
        raise library.NotMadeError("no compiler")

    if comm.rank == last:
        monkeypatch.setattr(library, "load", fail)
    with pytest.raises(RuntimeError, match="no compiler"):
        need_kernels(comm)
