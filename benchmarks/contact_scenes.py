"""Pictures of the scenes of contact with edges and of real parts on docs/contact_scenes.md.

    python benchmarks/contact_scenes.py                        # all, some minutes
    python benchmarks/contact_scenes.py gears hooks --to DIR   # in place of docs/contact_scenes

The scenes are those of the tests, whose functions run here: what is drawn is the state in which a
test compares numbers, or an earlier one where bodies are apart by then.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

import dolfinx_nts as nts
from dolfinx_nts.output.pictures import picture

ROOT = Path(__file__).resolve().parent.parent


class Scene(NamedTuple):
    """A picture.

    Attributes:
        test: Module of the tests.
        function: That makes and runs the scene.
        given: Its arguments.
        view: As of `picture`.
        end: Time up to which it runs [s]; None: all of it.
        colour: As of `picture`.
        limits: As of `picture`.
        units: As of `picture`.
        only: The bodies that are drawn, alone; none: all that is in the scene.
    """

    test: str
    function: str
    given: Mapping[str, Any]
    view: tuple[float, float] = (22.0, -60.0)
    end: float | None = None
    colour: str = "speed"
    limits: tuple[float, float] | None = None
    units: str = "m"
    only: tuple[str, ...] = ()


#: With which the lump hangs between the fingers: 0.95 of what their friction holds [N].
LOAD = 0.36

SCENES = {
    "gears": Scene(
        "test_gears", "test_spur_gears_turn_each_other", {"way": "wheel", "dt": 1e-4, "end": 6e-3},
        (90.0, -90.0),
    ),
    "crossed_bars": Scene(
        "test_edge_contact", "test_crossed_bars_bounce", {"cells": 12}, (15.0, -50.0), 6e-3
    ),
    "hooks": Scene(
        "test_real_parts", "test_hooks_hold_each_other", {"size": 1.5, "friction": 0.3},
        (12.0, -50.0), colour="stress", units="mm",
    ),
    "chain": Scene(
        "test_machine_parts", "test_links_of_a_chain_carry_one_force", {"links": 5}, colour="body",
        units="mm", only=tuple(f"link {k}" for k in range(5)),
    ),
    "coil_spring": Scene(
        "test_self_contact", "test_a_coil_spring_is_squeezed_until_it_closes", {}, (12.0, -60.0),
        colour="stress", limits=(0.0, 1.2e4),
    ),
    "peg": Scene(
        "test_peg", "test_a_peg_jams_if_friction_is_above_that_of_the_drawer",
        {"part": 1.2, "exchanged": False}, (12.0, -75.0), colour="body",
    ),
    "block_over_a_rim": Scene("test_edge_contact", "slide", {"facets": (4, 1)}, (10.0, -70.0)),
    "cube_edge_on_edge": Scene(
        "test_edge_contact", "test_crossed_edges_rebound_and_keep_energy_and_momenta",
        {"rule": "energy-momentum", "angle": 67.0, "friction": 0.4, "kind": None}, end=0.03,
    ),
    "cube_vertex_on_vertex": Scene(
        "test_vertices", "test_it_does_not_matter_which_cube_is_the_slave", {"scene": "vertices"},
        end=0.03,
    ),
    "cube_vertex_on_edge": Scene(
        "test_vertices", "test_it_does_not_matter_which_cube_is_the_slave",
        {"scene": "vertex on edge"}, end=0.03,
    ),
    "wedge": Scene(
        "test_machine_parts", "test_a_wedge_lifts_a_rigid_block_as_a_screw_does_its_nut",
        {"friction": 0.2, "exchanged": False}, (12.0, -75.0), colour="body",
    ),
    "gripper": Scene("test_gripper", "gripped", {"load": LOAD}, (15.0, -75.0), colour="stress"),
    "snap_fit": Scene(
        "test_machine_parts", "test_a_snap_fit_of_two_solids_takes_the_force_that_beams_say",
        {"kind": "soft", "exchanged": False}, (8.0, -80.0), colour="stress",
    ),
    "beams": Scene("test_thin_contact", "impact", {"case": "beam on beam"}, (20.0, -60.0)),
    "o_ring": Scene(
        "test_machine_parts", "seal", {"walls": "tetrahedra", "friction": 0.3, "rolls": True},
        (30.0, -75.0), colour="stress", units="mm", only=("cord", "groove"),
    ),
}  # fmt: skip


class _Drawn(Exception):
    """A scene that was not to go on."""


def draw(name: str, folder: Path) -> Path:
    """Run a scene and draw its bodies as the first of its runs leaves them.

    Args:
        name: Of the scene.
        folder: Of the picture.

    Returns:
        The picture.
    """
    scene, path = SCENES[name], folder / f"{name}.png"
    whole: dict[str, Any] = {}
    for solve in ("simulate", "equilibrium"):
        whole[solve] = getattr(nts, solve)

        def run(system: Any, *args: Any, solve: str = solve, **options: Any) -> Any:
            if scene.end is not None:
                options["t_end"] = scene.end
            done = whole[solve](system, *args, **options)
            picture(
                [b for b in system.bodies if b.name in scene.only] or done, path, width=2.4,
                colour=scene.colour, view=scene.view, limits=scene.limits, units=scene.units,
            )  # fmt: skip
            # Few colours take a third of the bytes.
            Image.open(path).convert("RGB").quantize(160).save(path, optimize=True)
            raise _Drawn

        setattr(nts, solve, run)
    try:
        getattr(importlib.import_module(scene.test), scene.function)(**scene.given)
    except _Drawn:
        return path
    finally:
        for solve, function in whole.items():
            setattr(nts, solve, function)
    raise RuntimeError(f"{name}: no run")


def main() -> None:
    """Draw the scenes that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument("--to", type=Path, default=ROOT / "docs/contact_scenes")
    given = parser.parse_args()
    sys.path[:0] = [str(ROOT / folder) for folder in ("demos", "meshes", "tests", "tests/contact")]
    given.to.mkdir(parents=True, exist_ok=True)
    for name in given.names or SCENES:
        start = time.perf_counter()
        path = draw(name, given.to)
        print(f"{path}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
