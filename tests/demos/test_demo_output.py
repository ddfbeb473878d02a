"""What every demo shows and leaves: a progress line, a picture, a film, and fields for ParaView."""

import importlib
from pathlib import Path

import pytest

from dolfinx_nts.output import Film, painting

SMALL = {
    "bar_impact": {"elements": 4, "t_end": 0.1},
    "crane": {"dt": 2e-2, "t_end": 0.1},
    "domino": {"dominoes": 3, "duration": 0.02},
    "drum_stick": {"cells": 4, "t_end": 5e-4},
    "flying_beam": {"steps": (0.5,), "t_end": 2.0, "integrators": ("energy-momentum",)},
    "flying_plate": {"steps": (0.1,), "t_end": 0.3, "integrators": ("energy-momentum",)},
    "flying_l_block": {"t_end": 2.0},
    "heavy_top": {"steps": (4e-3,), "t_end": 0.02, "size": 0.05},
    "leaf_spring": {"cells": 8, "steps": 5, "t_end": 1e-3},
    "mechanisms": {"cases": ("bricard",), "t_end": 0.2},
    "newtons_cradle": {
        "kinds": ("rigid, touching",),
        "parts": (0.5,),
        "cells": 2,
        "duration": 2e-3,
    },
    "partial_slip": {"scales": (0.01,), "refinement": 0.5},
    "own_problem": {"cells": 2, "steps": 4},
    "hertz": {"problems": ("cylinders",), "scales": (0.01,), "refinement": 0.5},
    "ironing": {"block": (16, 2), "die": (4, 2), "steps": (10, 50), "end": 0.2},
    "robot_arm": {"cases": ("holds",), "t_end": 0.04},
    "rolling": {"facets": 16, "duration": 0.016, "integrators": ("energy-momentum",)},
    "rotating_cross": {"steps": (0.05,), "t_end": 0.2},
    "slider_crank": {"rods": ("flexible",), "t_end": 0.002, "cells": 4},
    "snap_fit": {"cells": 4, "steps": 2, "t_end": 5e-4},
    "sliding_block": {"floors": ("plane",), "dt": 8e-3, "cells": (2, 2, 1)},
    "slope": {"floors": ("plane",), "parts": ("verge",), "cells": (2, 2, 1)},
    "stability": {"steps": {"rubbing": 5}},
    "stick_slip": {"floors": ("plane",), "dt": 8e-3, "cells": (2, 2, 1)},
    "two_blocks": {"t_end": 0.01, "cells": (1, 1)},
    "two_tori": {"t_end": 0.1},
    "vehicle": {"facets": 16, "t_end": 0.02},
    "wheel": {"facets": 16, "dt": 4e-3, "duration": 0.012},
}
#: Equilibria alone, in which next to nothing moves.
STILL = {"own_problem", "hertz", "partial_slip"}
#: Bodies without meshes, which have no fields.
BARE = {"mechanisms"}
DEMOS = Path(__file__).resolve().parents[2] / "demos"


def test_all_are_here():
    assert set(SMALL) == {path.stem for path in DEMOS.glob("*.py")}


@pytest.mark.fast("own_problem")
@pytest.mark.parametrize("name", SMALL)
def test_what_a_demo_leaves(name, tmp_path, capfd, monkeypatch):
    """In few patches, films of the first and last state: painting takes most of the time."""
    demo, init = importlib.import_module(name), Film.__init__

    def brief(film, path, *, every=1, interval=None, **look):
        init(film, path, every=10**6, **look)

    monkeypatch.setattr(Film, "__init__", brief)
    monkeypatch.setattr(painting, "_PATCHES", 1)
    demo.main(output=str(tmp_path), progress=True, **SMALL[name])
    assert "step/s" in capfd.readouterr().err.replace("s/step", "step/s")
    fields = [] if name in BARE else [".xdmf", ".h5"]
    for ending in (".png", *fields, *([] if name in STILL else [".gif"])):
        sizes = [path.stat().st_size for path in tmp_path.rglob(f"*{ending}")]
        assert sizes and min(sizes) > 500, ending
    if fields:
        times = [path.read_text().count("<Time Value") for path in tmp_path.rglob("*.xdmf")]
        assert max(times) >= 2
