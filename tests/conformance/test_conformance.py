"""What holds for every scene: ledger, momenta, order; no frame, rank, pause or rounding matters."""

from functools import cache

from mpi4py import MPI

import noise
import numpy as np
import pytest
from conformance_scenes import (
    SCENES,
    beam,
    beam_on_a_plate,
    block_on_a_plane,
    edges_and_vertices,
    fold,
    in_an_angle,
    laws_in_joints,
    leaf_on_a_pad,
    mechanism,
    of_degree_two,
    over_waves,
    rigid_on_rubber,
    sewn,
    tied,
    tipping,
    two_blocks,
)
from frames import Frame
from integrators import INTEGRATORS, MID_STEP
from rotations import rotation

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
STEPS = 12
RULE = nts.EnergyMomentum()
TURN = rotation(1.1, (1, 2, -0.5))
#: Frames that must not matter: numbers much larger and much smaller, turned, in another order.
FRAMES = {
    "millimetres": Frame(unit=1e3, turn=TURN, shuffle=3),
    "micrometres": Frame(unit=1e-6, turn=TURN.T, shuffle=4),
}  # fmt: skip
#: Part of the scene's size by which places may differ: the solver's tolerance, and what contacts
#: make of it in so few steps.
ALIKE = 1e-7
#: Each scene by one integrator, and two of them by each.
PAUSED = [
    (scene, name) for scene in SCENES for name in INTEGRATORS
    if name == "energy-momentum" or scene in (mechanism, two_blocks)
]  # fmt: skip
#: Laws that hold and let go have no accelerations, nor have nodes without mass.
UNACCELERATED = (laws_in_joints, tipping, block_on_a_plane)


def others(scene):
    """Names of the other integrators that take a scene."""
    return [
        name for name, rule in INTEGRATORS.items()
        if name != "energy-momentum" and not (scene in UNACCELERATED and rule.accelerations)
    ]  # fmt: skip


#: Each scene by one of them, in turn, and two by each.
OTHERS = [
    (scene, name) for k, scene in enumerate(SCENES) for name in others(scene)
    if scene in (mechanism, two_blocks) or name == others(scene)[k % len(others(scene))]
]  # fmt: skip
#: Scenes of bodies that nothing holds or drives.
FREE = (
    two_blocks, tied, fold, of_degree_two, beam_on_a_plate, over_waves, leaf_on_a_pad, in_an_angle,
    edges_and_vertices,
)  # fmt: skip
#: Options of a run, each with a scene on which it acts.
OPTIONS = {
    "restored": (two_blocks, {"impact": "restored"}),
    "adapted": (rigid_on_rubber, {"adapt": nts.Adapt(tolerance=1e-3)}),
    "asleep": (block_on_a_plane, {"sleep": True}),
    "kept matrices": (two_blocks, {"newton": nts.Newton(rtol=1e-13, reuse=True)}),
    "krylov": (leaf_on_a_pad, {"newton": nts.Newton(rtol=1e-13, linear_solver="krylov")}),
}  # fmt: skip
#: Scenes whose rest is looked for, too.
AT_REST = (beam, sewn, rigid_on_rubber)
scenes = pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.__name__)


def places(body, frame):
    """The scene's places of a body's nodes (n, 3), in the order of the reference, on all ranks."""
    for name in ("centreline", "midsurface"):
        if hasattr(body, name):
            before, now = getattr(body, name)()
            break
    else:
        owned = body.space.dofmap.index_map.size_local
        before = body.space.tabulate_dof_coordinates()[:owned]
        now = before + body.u.x.array.reshape(-1, 3)[:owned]
        before, now = (np.concatenate(frame.comm.allgather(a)) for a in (before, now))
    order = np.lexsort(frame.back(before).round(6).T)
    return frame.back(now)[order]


def end(run, frame):
    """Places of all bodies, one below the other."""
    return np.concatenate([places(body, frame) for body in run.system.bodies])


def run_of(scene, frame, rule=RULE, *, steps=STEPS, dt=None, **options):
    """The scene's run; places of all bodies at its end, and its balance."""
    dt = SCENES[scene] if dt is None else dt
    if "newton" not in options:
        options["accuracy"] = "exact"
    with options.pop("system", None) or scene(frame) as system:
        run = nts.simulate(system, rule, dt=dt, t_end=steps * dt, **options)
        assert run.status.startswith("completed"), run.status
        return end(run, frame), run.balance


def rest_of(scene, frame):
    """Places of all bodies in equilibrium, which stabilization leads to."""
    with scene(frame) as system:
        run = nts.equilibrium(system, load_steps=2, stabilization=0.1)
        assert run.status.startswith("completed"), run.status
        return end(run, frame)


@cache
def plain(scene, name="energy-momentum"):
    return run_of(scene, Frame(), INTEGRATORS[name])


def assert_alike(found, expected):
    size = np.ptp(expected, axis=0).max()
    assert np.abs(found - expected).max() < ALIKE * size


def test_each_body_coupling_and_law_of_the_package_has_a_scene():
    seen = set()
    for scene in SCENES:
        system = scene(Frame())
        things = [*system.bodies, *system.joints, *(pair.master for pair in system.contacts)]
        things += [body.material for body in system.bodies if isinstance(body, nts.Continuum)]
        seen |= {type(thing) for thing in things}
    bases = nts.Body, nts.Joint, nts.BetweenPoints, nts.AboutAxis, nts.Obstacle, nts.Isotropic
    wanted = {
        kind for kind in vars(nts).values()
        if isinstance(kind, type) and issubclass(kind, bases) and kind not in bases
    }  # fmt: skip
    assert not wanted - seen


@pytest.mark.mpi
@scenes
def test_the_ledger_closes(scene):
    """And in each scene something moves, is stored, or is pressed, slips and stays outside."""
    _, table = plain(scene)
    top = max(np.abs(table[name]).max() for name in ("kinetic", "potential", "external_work"))
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * top
    assert np.all(np.diff(table["friction_dissipation"]) >= -1e-12 * top)
    if scene(Frame()).contacts:
        assert table["min_gap"].min() > -1e-12 and table["slip"].any()


@pytest.mark.mpi
@pytest.mark.parametrize("name", MID_STEP)
@pytest.mark.parametrize("scene", FREE, ids=lambda scene: scene.__name__)
def test_free_bodies_keep_their_momenta(scene, name):
    _, table = plain(scene, name)
    for column in ("linear_momentum", "angular_momentum"):
        values = table[column]
        assert np.abs(values - values[0]).max() < 1e-11 * np.abs(values).max()


@pytest.mark.mpi
@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
@scenes
def test_no_frame_matters(scene, frame):
    found, table = run_of(scene, frame)
    expected, before = plain(scene)
    assert_alike(found, expected)
    top = np.abs(before["energy"]).max()
    assert np.allclose(table["energy"] / frame.unit**5, before["energy"], rtol=0, atol=1e-7 * top)


@pytest.mark.parametrize(("scene", "name"), OTHERS, ids=lambda v: getattr(v, "__name__", v))
@pytest.mark.slow
def test_no_frame_matters_to_any_integrator(scene, name):
    found, _ = run_of(scene, Frame(unit=1e3, turn=TURN, shuffle=5), INTEGRATORS[name])
    assert_alike(found, plain(scene, name)[0])


@pytest.mark.parametrize("name", OPTIONS)
def test_no_frame_matters_to_options_of_a_run(name):
    """And the ledger closes."""
    scene, options = OPTIONS[name]
    expected, table = run_of(scene, Frame(), **options)
    found, _ = run_of(scene, Frame(unit=1e-3, turn=TURN, shuffle=6), **options)
    assert_alike(found, expected)
    top = max(np.abs(table[name]).max() for name in ("energy", "external_work"))
    assert np.abs(table["ledger_residual"]).max() < 1e-11 * top


@pytest.mark.mpi
@pytest.mark.parametrize("scene", AT_REST, ids=lambda scene: scene.__name__)
def test_no_frame_and_no_rank_matters_at_rest(scene):
    found = rest_of(scene, Frame())
    other = Frame(unit=1e3, turn=TURN, shuffle=7, comm=MPI.COMM_SELF)
    assert_alike(rest_of(scene, other), found)


@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.mpi
def test_no_rank_matters():
    for scene in SCENES:
        assert_alike(run_of(scene, Frame(comm=MPI.COMM_SELF))[0], plain(scene)[0])


@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize("written", ["on all", "on one"])
def test_a_run_goes_on_on_other_ranks(written, mpi_tmp_path):
    """A rank alone goes on from a file that all have written, and all from that of one."""
    half, alone = STEPS // 2, MPI.COMM_SELF
    first, then = (COMM, alone) if written == "on all" else (alone, COMM)
    for scene, dt in SCENES.items():
        name = scene.__name__ + ("" if written == "on all" else f"-{COMM.rank}")
        saves = nts.Checkpoint(mpi_tmp_path / f"{name}.h5", every=half)
        run_of(scene, Frame(comm=first), steps=half, checkpoint=saves)
        COMM.barrier()
        path = mpi_tmp_path / f"{scene.__name__}{'' if written == 'on all' else '-0'}.h5"
        frame = Frame(comm=then)
        system = scene(frame)
        start = nts.restart(path, system)
        assert_alike(run_of(scene, frame, system=system, start=start, dt=dt)[0], plain(scene)[0])


@pytest.mark.parametrize("ranks", [3, 4])
def test_no_number_of_ranks_matters(on_ranks, ranks):
    """On 3 ranks some own no slave node, on 4 the contact zone is cut by the partition."""
    name = f"{__file__}::test_no_rank_matters"
    on_ranks(ranks, "-m", "pytest", "-q", "-p", "no:cacheprovider", name)


@pytest.mark.parametrize(("scene", "name"), PAUSED, ids=lambda v: getattr(v, "__name__", v))
def test_a_run_goes_on_where_a_checkpoint_was_written(scene, name, tmp_path):
    path, half, dt, rule = tmp_path / "run.h5", STEPS // 2, SCENES[scene], INTEGRATORS[name]
    written = nts.Checkpoint(path, every=half)
    run_of(scene, Frame(), rule, steps=half, checkpoint=written)
    system = scene(Frame())
    found, table = run_of(
        scene, Frame(), rule, system=system, start=nts.restart(path, system), dt=dt
    )
    expected, before = plain(scene, name)
    assert len(table["time"]) == STEPS + 1
    assert np.abs(found - expected).max() < 1e-9 * np.ptp(expected, axis=0).max()
    assert np.allclose(table["energy"], before["energy"], rtol=1e-9)


@scenes
def test_no_rounding_matters(scene, monkeypatch):
    expected, _ = plain(scene)
    noise.install("both", 1, monkeypatch.setattr)
    found, _ = run_of(scene, Frame())
    assert (found != expected).any()
    assert_alike(found, expected)


@pytest.mark.parametrize(("scene", "dt"), [(mechanism, 2e-2), (tied, 2e-3)], ids=["links", "rod"])
@pytest.mark.parametrize("name", INTEGRATORS)
def test_smooth_scenes_converge_by_the_second_order(name, scene, dt):
    """By halving the step twice."""
    ends = [run_of(scene, Frame(), INTEGRATORS[name], steps=8 * n, dt=dt / n)[0] for n in (1, 2, 4)]
    coarse, fine = (np.linalg.norm(a - b) for a, b in zip(ends, ends[1:], strict=False))
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)
