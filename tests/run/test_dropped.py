"""What a caller sets and a run would drop is refused before work, on all ranks."""

import numpy as np
import pytest
from scenes import RUBBER, box

import dolfinx_nts as nts

pytestmark = pytest.mark.mpi


def cube(name="cube", **options):
    return nts.Continuum(box(cells=1), RUBBER, density=1e3, name=name, **options)


def moved(body, **options):
    return nts.simulate(
        nts.System([body]), nts.EnergyMomentum(), dt=1e-2, t_end=2e-2, **options
    )


@pytest.mark.parametrize(("which", "option"), [("u", "displacement"), ("v", "velocity")])
@pytest.mark.parametrize("kind", ["flexible", "rigid"])
def test_what_was_written_into_u_or_v_is_not_dropped_in_silence(kind, which, option):
    body = cube() if kind == "flexible" else nts.RigidBody(box(cells=1), density=1e3, name="cube")
    text = rf"body 'cube': its {which} was written.*pass {option}= to the body, or start="
    function = getattr(body, which)
    function.interpolate(lambda x: np.full(x.shape, 2.0))
    with pytest.raises(ValueError, match=text):
        moved(body)
    # The refusal has undone it.
    run = moved(body)
    assert run.status == "completed" and not run.balance["energy"].any()
    # Of runs that follow each other none writes for the caller, with or without start.
    assert moved(body, start=run, start_time=0.0).status == "completed"
    assert moved(body).status == "completed"
    function.x.array[-1:] = 1.0
    with pytest.raises(ValueError, match=text):
        moved(body, start=run, start_time=0.0)


@pytest.mark.parametrize("kind", ["flexible", "rigid"])
def test_a_mesh_that_moved_after_its_body_was_made(kind):
    body = cube() if kind == "flexible" else nts.RigidBody(box(cells=1), density=1e3, name="cube")
    body.mesh.geometry.x[-1:, 2] += 0.1
    with pytest.raises(ValueError, match="mesh of 'cube': its nodes were moved after the body"):
        moved(body)
