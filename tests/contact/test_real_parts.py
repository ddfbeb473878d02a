"""Parts of Gmsh's tetrahedra that hook into each other; an independent twin looks for overlap."""

import numpy as np
import pytest
from gmsh_parts import deepest, of_gmsh
from scenes import everywhere

import dolfinx_nts as nts

#: Radii of the hooks and of their wire [mm].
RADIUS, THICK = 10.0, 3.0


def hook(turned):
    """Three quarters of a ring of 20 mm on a shank along z; or upside down and turned by 90."""
    long = 20.0

    def draw(occ):
        ring = occ.addTorus(0, 0, 0, RADIUS, THICK, angle=1.5 * np.pi)
        occ.rotate([(3, ring)], 0, 0, 0, 1, 0, 0, np.pi / 2)
        out, _ = occ.fuse([(3, ring)], [(3, occ.addCylinder(RADIUS, 0, 0, 0, 0, -long, THICK))])
        if turned:
            occ.rotate(out, 0, 0, 0, 1, 0, 0, np.pi)
            occ.rotate(out, 0, 0, 0, 0, 0, 1, np.pi / 2)
            # 0.02 mm are left between the hooks.
            occ.translate(out, 0, 0, 2.0 * (RADIUS - THICK) - 0.02)
        return out

    return draw


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("size", [3.0, 1.5])
def test_hooks_hold_each_other(size, friction):
    """Pulled apart by 1 mm they carry what is pulled, without help from the user."""
    steel = nts.NeoHookean(young=2e5, poisson=0.3)
    bodies = []
    for turned, name in ((False, "low"), (True, "up")):
        end = -20.0 if not turned else 33.98
        held = nts.Dirichlet(
            lambda x, end=end: np.abs(x[2] - end) < 1e-6,
            value=lambda t, turned=turned: (0, 0, t if turned else 0.0),
        )
        part = of_gmsh(hook(turned), size)
        bodies.append(part.continuum(steel, density=7.8e-9, degree=1, bcs=[held], name=name))
    low, up = bodies
    pair = nts.ContactPair(up.surface(everywhere), low.surface(everywhere), friction=friction)
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]), load_steps=8)
    assert run.status == "completed"
    pulled, force = run.reactions["up"][-1, 0], run.contact_forces[-1, 0]
    assert pulled[2] > 1e3
    assert force == pytest.approx(-pulled, abs=1e-6 * pulled[2])
    # Slave nodes are held out, but for one in a valley of the coarse master, which one of the two
    # facets holds; the master's come in by the sag of the slave's flat facets.
    assert deepest(up, low) < (0.05 if size == 3.0 else 1e-6)
    assert deepest(low, up) < size / 8.0 * (1.0 / THICK + 1.0 / (RADIUS - THICK))
