"""Which element: error of an answer over time, coordinates and cells, for four parts.

    python benchmarks/elements.py                                   # roller cook block bracket
    python benchmarks/elements.py roller --picture docs/which_element.png

- roller: a cantilever of 10 x 1 x 1 at nu = 0.3 that a rigid cylinder lifts at 9 of its length: the
  contact force beside 3 EI w/a^3.
- cook: Cook's membrane in plane strain at nu = 0.499975, small load: the tip beside 16.4326 of
  Krysl.
- block: a bonded rubber block, 1 x 1 x 0.5, nu = 0.4999, pressed by 10 %: the force, beside 0.0475,
  to which a quarter of 2^3, 4^3, 8^3 and 12^3 projected hexahedra leads (0.0571, 0.0515, 0.0492,
  0.0484).
- bracket: an angle of steel, 40 x 40 x 20 mm and 5 mm thick, bolted down at one leg, with a small
  load at the end of the other: its deflection, beside that of tetrahedra of degree 2 of 1.5 mm.

Times are processor time of an `equilibrium` whose forms are compiled, the least of two.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import gmsh
import numpy as np
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts

COMM = MPI.COMM_SELF
#: Cells and options of bodies by the name of the element.
ELEMENTS: dict[str, tuple[CellType, dict[str, Any]]] = {
    "tetrahedra": (CellType.tetrahedron, {}),
    "tetrahedra, degree 2": (CellType.tetrahedron, {"degree": 2}),
    "hexahedra": (CellType.hexahedron, {}),
    "hexahedra, projected": (CellType.hexahedron, {"volume": "projected"}),
    "hexahedra, bending": (CellType.hexahedron, {"bending": True}),
    "hexahedra, degree 2": (CellType.hexahedron, {"degree": 2}),
}


class Row(NamedTuple):
    """One run."""

    element: str
    size: str
    coordinates: int
    seconds: float
    answer: float


def plane(axis: int, value: float) -> Any:
    """Marker of a plane across an axis."""
    return lambda x: np.abs(x[axis] - value) < 1e-9


def solved(system: nts.System, **options: Any) -> Any:
    """Load steps; RuntimeError with the reason where they stop."""
    run = nts.equilibrium(system, **options)
    if run.status != "completed":
        raise RuntimeError(run.status)
    return run


# ---- the parts: of an element and a size the coordinates, and what computes the answer
def roller(kind: CellType, options: dict[str, Any], n: int) -> tuple[int, Callable[[], float]]:
    """Force of the cylinder, over that of Euler and Bernoulli."""
    mesh = create_box(COMM, [[0, 0, 0], [10, 1, 1]], [10 * n, n, n], kind)
    bar = nts.Continuum(
        mesh, nts.StVenantKirchhoff(1.0, 0.3), density=1.0, bcs=[nts.Dirichlet(plane(0, 0.0))],
        **options,
    )  # fmt: skip
    roll = nts.Cylinder((9, 0, -1), (0, 1, 0), 1.0, motion=lambda t: (0, 0, 0.1 * t))
    system = nts.System([bar], contacts=[nts.ContactPair(bar.surface(plane(2, 0.0)), roll)])
    exact = 3 / 12 * 0.1 / 9**3
    return bar.num_owned, lambda: float(
        solved(system, load_steps=1).contact_forces[-1, 0, 2] / exact
    )


def cook(kind: CellType, options: dict[str, Any], n: int) -> tuple[int, Callable[[], float]]:
    """Deflection of the tip over that of Krysl."""
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 4.0 / n]], [n, n, 1], kind)
    x = mesh.geometry.x
    # Diagonals of tetrahedra run the short way: along the other they lock twice as much.
    s, t = x[:, 0].copy(), 1.0 - x[:, 1]
    x[:, 0], x[:, 1] = 48.0 * s, 44.0 * s + t * (44.0 - 28.0 * s)
    mu, lam, load = 0.375, 7500.0, 1e-5
    nu = lam / (2 * (lam + mu))
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=2 * mu * (1 + nu), poisson=nu), density=1.0, **options,
        bcs=[
            nts.Dirichlet(plane(0, 0.0)),
            *(nts.Dirichlet(plane(2, z), components=[2]) for z in (0.0, 4.0 / n)),
        ],
        traction=[nts.Traction(plane(0, 48.0), (0.0, load / 16.0, 0.0))],
    )  # fmt: skip
    tip = np.abs(body.reference.reshape(-1, 3)[:, :2] - [48.0, 52.0]).max(axis=1) < 1e-9

    def answer() -> float:
        u = solved(nts.System([body])).state.u[0].reshape(-1, 3)
        return float(u[tip, 1].mean() / load / 16.4326)

    return body.num_owned, answer


def block(kind: CellType, options: dict[str, Any], n: int) -> tuple[int, Callable[[], float]]:
    """Force that presses a quarter of it by 10 % [N], its modulus 1 Pa."""
    mesh = create_box(COMM, [[0, 0, 0], [0.5, 0.5, 0.5]], [n, n, n], kind)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1.0, poisson=0.4999), density=1.0, **options,
        bcs=[
            nts.Dirichlet(plane(2, 0.0)),
            nts.Dirichlet(plane(2, 0.5), lambda t: (0.0, 0.0, -0.05 * min(t, 1.0))),
            *(nts.Dirichlet(plane(k, 0.0), components=[k]) for k in (0, 1)),
        ],
    )  # fmt: skip
    system = nts.System([body])
    return body.num_owned, lambda: float(
        -solved(system, load_steps=4).reactions[body.name][-1, 1, 2]
    )


def angle(size: float) -> Any:
    """Mesh of the bracket in tetrahedra [mm]."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    legs = [gmsh.model.occ.addBox(0, 0, 0, *ends) for ends in ((40, 20, 5), (5, 20, 40))]
    whole, _ = gmsh.model.occ.fuse([(3, legs[0])], [(3, legs[1])])
    hole = gmsh.model.occ.addCylinder(25, 10, -1, 0, 0, 7, 4)
    gmsh.model.occ.cut(whole, [(3, hole)])
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(3, [tag for _, tag in gmsh.model.getEntities(3)], 1)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Mesh.MeshSizeMin", size)
    gmsh.model.mesh.generate(3)
    (part,) = nts.bodies_from_gmsh(gmsh.model, COMM).values()
    gmsh.finalize()
    return part.mesh


def bracket(kind: CellType, options: dict[str, Any], n: float) -> tuple[int, Callable[[], float]]:
    """Deflection of the loaded end [mm]."""
    body = nts.Continuum(
        angle(n), nts.NeoHookean(young=2.1e5, poisson=0.3), density=7.8e-9, **options,
        bcs=[nts.Dirichlet(lambda x: (x[2] < 1e-9) & ((x[0] - 25) ** 2 + (x[1] - 10) ** 2 < 81))],
        traction=[nts.Traction(plane(2, 40.0), (0.1, 0.0, 0.0))],
    )  # fmt: skip
    end = body.reference.reshape(-1, 3)[:, 2] > 40.0 - 1e-6
    system = nts.System([body])
    return body.num_owned, lambda: float(
        solved(system).state.u[0].reshape(-1, 3)[end, 0].mean()
    )


#: Of each part what makes it, its sizes by the degree of cells, and the reference: an answer, or
#: element and size.
PARTS: dict[str, Any] = {
    "roller": (roller, {1: (1, 2, 4), 2: (1, 2)}, 1.0),
    "cook": (cook, {1: (4, 8, 16, 32), 2: (2, 4, 8, 16)}, 1.0),
    "block": (block, {1: (2, 4, 8), 2: (1, 2, 4)}, 0.0475),
    "bracket": (bracket, {1: (5.0, 2.5, 1.5), 2: (5.0, 2.5)}, ("tetrahedra, degree 2", 1.5)),
}


def measure(part: str, element: str, size: Any) -> Row:
    """Run it twice."""
    make, seconds, answer = PARTS[part][0], [], np.nan
    for _ in range(2):
        coordinates, run = make(*ELEMENTS[element], size)
        start = time.process_time()
        try:
            answer = run()
        except RuntimeError as error:
            print(f"    {element}, {size}: {error}")
        seconds.append(time.process_time() - start)
    return Row(element, str(size), coordinates, min(seconds), answer)


def compare(part: str) -> tuple[list[Row], float]:
    """All runs of a part, and the right answer."""
    _, sizes, reference = PARTS[part]
    right = reference if isinstance(reference, float) else measure(part, *reference).answer
    rows = []
    for element, (kind, options) in ELEMENTS.items():
        if part == "bracket" and kind != CellType.tetrahedron:
            continue
        rows += [measure(part, element, size) for size in sizes[options.get("degree", 1)]]
        for row in rows[-len(sizes[options.get("degree", 1)]) :]:
            off = 100 * (row.answer / right - 1)
            print(
                f"{part:8s} {row.element:22s} {row.size:>4s} {row.coordinates:7d} coordinates "
                f"{row.seconds:7.2f} s {off:+8.2f} %",
                flush=True,
            )
    return rows, right


def draw(found: dict[str, tuple[list[Row], float]], path: Path) -> None:
    """Error over time."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(found), figsize=(4 * len(found), 4.2))
    for axis, (part, (rows, right)) in zip(np.atleast_1d(axes), found.items(), strict=True):
        for element in ELEMENTS:
            own = [row for row in rows if row.element == element]
            errors = [100 * abs(row.answer / right - 1) for row in own]
            axis.loglog([row.seconds for row in own], errors, "o-", label=element)
        axis.set(title=part, xlabel="processor time [s]", ylabel="error [%]")
        axis.grid(alpha=0.3)
    handles, labels = np.atleast_1d(axes)[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=6)
    figure.tight_layout(rect=(0.0, 0.08, 1.0, 1.0))
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure and print; see the top of the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=[], help=f"some of {list(PARTS)}")
    parser.add_argument("--picture", type=Path, help="file of the work-precision diagram")
    arguments = parser.parse_args()
    found = {part: compare(part) for part in arguments.parts or PARTS}
    if arguments.picture:
        draw(found, arguments.picture)


if __name__ == "__main__":
    main()
