"""Contact by nodes and over the slave's surface side by side: errors, iterations, time.

    python benchmarks/nodes_and_surface.py                        # patch, coarse, hertz, cost
    python benchmarks/nodes_and_surface.py hertz --picture docs/nodes_and_surface.png

- patch: two blocks of n^2 on m^2 cells across, pressed together by a uniform load; the right
  pressure and stress are uniform.
- coarse: the two blocks of `demos/two_blocks.py`, the coarse one as slave.
- hertz: the cylinders of `demos/hertz.py` under a hundredth of their load, on meshes that match and
  that do not. The error is the root mean square of the forces of nodes beside those of Hertz's
  pressure, the integrals of it times the nodes' hat functions, both over the nodes' areas.
- cost: two cubes of n^3 and (n + 1)^3 cells that collide flat, runs in turns, processor time.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box
from scipy.spatial import cKDTree

import dolfinx_nts as nts
from dolfinx_nts.kernels import compiled, facets

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "demos"))
import hertz
import two_blocks

COMM = MPI.COMM_SELF
WAYS = ("nodes", "surface")
#: Pairs of meshes: cells of slave and master.
PATCHES = ((3, 2), (2, 3), (4, 3), (2, 6))
MESHES = ((8, 6), (12, 9), (16, 12), (24, 18), (8, 11), (16, 22), (8, 8), (16, 16), (24, 24))
_STRAIN = 1e-4


def plane(axis: int, value: float) -> Any:
    """Marker of a plane across an axis."""
    return lambda x: np.abs(x[axis] - value) < 1e-9


def pressure(run: Any) -> tuple[Any, Any]:
    """The slave, and pressures at its nodes [Pa]."""
    slave = run.system.contacts[0].slave
    (name,) = (n for n in run.contact_fields(slave.body) if n.startswith("contact_pressure"))
    field = run.contact_fields(slave.body)[name]
    nodes = cKDTree(field.function_space.tabulate_dof_coordinates())
    return slave, field.x.array[nodes.query(slave.reference)[1]]


# ---- patch test
def patch(cells: tuple[int, int], kind: CellType, way: str) -> tuple[float, float]:
    """Largest errors of pressure and vertical stress, over the right ones."""
    material, bodies = nts.StVenantKirchhoff(1.0, 0.0), []
    for n, low in zip(cells, (0.5, 0.0), strict=True):
        mesh = create_box(COMM, [[0, 0, low], [1, 1, low + 0.5]], [n, n, 2], kind)
        held = [nts.Dirichlet(plane(k, 0.0), components=(k,)) for k in (0, 1, 2)[: 2 if low else 3]]
        load = [nts.Traction(plane(2, 1.0), (0, 0, -_STRAIN))] if low else []
        bodies.append(
            nts.Continuum(mesh, material, density=1.0, bcs=held, traction=load, name=f"at {low}")
        )
    slave, master = (body.surface(plane(2, 0.5)) for body in bodies)
    pair = nts.ContactPair(slave, master, integration=way)
    run = nts.equilibrium(nts.System(bodies, contacts=[pair]))
    assert run.status == "completed"
    worst = 0.0
    for body in bodies:
        stress = nts.cauchy_stress(body, at="cells").x.array.reshape(-1, 9)[:, 8]
        worst = max(worst, float(np.abs(stress / -_STRAIN - 1.0).max()))
    return float(np.abs(pressure(run)[1] / _STRAIN - 1.0).max()), worst


# ---- the coarse side as slave
def entered(of: Any, into: Any, state: Any, system: nts.System) -> float:
    """How deep nodes of a surface lie behind facets of another one at most [m]."""
    x, y = (s.positions(state.u[system.bodies.index(s.body)]) for s in (of, into))
    corners, deepest = y[into.facets], 0.0
    for point in x:
        xi, distance = compiled.closest_point(np.tile(point, (len(corners), 1)), corners)
        near = [int(distance.argmin())]
        foot, _, normal = facets.frame(corners[near], xi[near])
        depth = float((foot[0] - point) @ normal[0])
        # Nodes beyond the rim have nothing over them.
        if distance[near[0]] < 1.01 * depth:
            deepest = max(deepest, depth)
    return deepest


def deepest(way: str) -> tuple[float, float]:
    """How deep nodes of the coarse slave and of its master enter the other block, of its edge."""
    scene = two_blocks.scene(COMM, integration=way)
    fine = scene.contacts[0]
    pair = nts.ContactPair(fine.master, fine.slave, integration=way)
    system = nts.System(scene.bodies, contacts=[pair])
    slave, master, depths = pair.slave, pair.master, np.zeros(2)
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    for _ in range(60):
        state = stepper.advance(2e-3)
        both = entered(slave, master, state, system), entered(master, slave, state, system)
        depths = np.maximum(depths, both)
    stepper.close()
    return float(depths[0]), float(depths[1])


# ---- Hertz
def cylinders(problem: Any, lower: int, way: str) -> nts.System:
    """The demo's cylinders, the lower one with another number of cells."""
    same = hertz.half_round

    def half_round(comm: Any, of: Any, *, lower: bool, whole: bool) -> Any:
        if not lower:
            return same(comm, of, lower=lower, whole=whole)
        cells, points = hertz.MESHES["half_cylinder"](number, of.radius, of.block, whole=whole)
        points[:, 1] *= number / of.cells
        points[:, 2] *= -1
        return hertz.create_mesh(comm, np.roll(cells, 4, axis=1), points, "hexahedron")

    number, hertz.half_round = lower, half_round
    try:
        system: nts.System = hertz.pressed(COMM, problem, integration=way)
    finally:
        hertz.half_round = same
    return system


def means(problem: Any, slave: Any) -> Any:
    """Hertz's pressure in the mean around each node, weighted with its hat function [Pa]."""
    # Facets reach along the cylinder; across it each hat is a triangle on the arc.
    x = np.unique(np.round(slave.reference[:, 0], 12))
    total, weight = np.zeros((2, len(x)))
    t = (np.arange(400) + 0.5) / 400
    for k in range(len(x) - 1):
        at = x[k] + (x[k + 1] - x[k]) * t
        for node, hat in ((k, 1 - t), (k + 1, t)):
            total[node] += (hat * problem.pressure(at)).sum() * (x[k + 1] - x[k])
            weight[node] += hat.sum() * (x[k + 1] - x[k])
    return np.interp(slave.reference[:, 0], x, total / weight)


def press(cells: tuple[int, int], way: str) -> dict[str, Any]:
    """Error of the pressure, iterations, and the profile over half-width and peak."""
    problem = replace(hertz.PROBLEMS["cylinders"].scaled(0.01), cells=cells[0])
    run = nts.equilibrium(cylinders(problem, cells[1], way), load_steps=2)
    assert run.status == "completed", run.status
    slave, found = pressure(run)
    exact, area = means(problem, slave), slave.area
    order = np.argsort(slave.reference[:, 0])
    return {
        "error": np.sqrt((area * (found - exact) ** 2).sum() / (area * exact**2).sum()),
        "iterations": int(run.balance["newton_iterations"].sum()),
        "x": slave.reference[order, 0] / problem.half_width,
        "p": found[order] / problem.peak,
    }


def draw(found: dict[tuple[tuple[int, int], str], dict[str, Any]], path: str) -> None:
    """A picture of the pressure on one pair of meshes, and of the errors on all."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    x = np.linspace(0.0, 1.3, 1001)
    left.plot(x, hertz.half_ellipse(x), "k", lw=1, label="Hertz")
    for way, sign in zip(WAYS, "ox", strict=True):
        profile = found[(16, 22), way]
        look = {"marker": sign, "ls": "none", "mfc": "none"}
        left.plot(profile["x"], profile["p"], label=f'"{way}"', **look)
        for ratio, line in (((4, 3), "-"), ((8, 11), "--"), ((1, 1), ":")):
            cells = [c for c in MESHES if c[0] * ratio[1] == c[1] * ratio[0]]
            errors = [100 * found[c, way]["error"] for c in cells]
            look = {"marker": sign, "ls": line, "mfc": "none", "color": f"C{sign == 'x':d}"}
            label = f'"{way}", {ratio[0]} on {ratio[1]}'
            right.loglog([c[0] / hertz.BLOCK for c in cells], errors, label=label, **look)
    left.set(xlabel="x / a", ylabel="p / p0", title="16 on 22 cells")
    right.set(xlabel="cells of the slave to the half-width a", ylabel="rms error of pressure [%]")
    right.legend(fontsize="x-small")
    left.legend(fontsize="small")
    figure.savefig(path, dpi=110)


# ---- cost
def collide(n: int, way: str) -> tuple[float, int]:
    """Processor time [s] and Newton iterations of two cubes that meet flat and spin, 60 steps."""
    rubber, bodies = nts.NeoHookean(young=1e6, poisson=0.3), []
    for low, cells in ((0.0, n), (1.004, n + 1)):
        mesh = create_box(COMM, [[low, 0, 0], [low + 1, 1, 1]], [cells] * 3, CellType.hexahedron)
        thrown = (0, 0, 0) if low else lambda x: np.array(
            [2 + 0.5 * (x[2] - 0.5), 0 * x[0], -0.5 * (x[0] - 0.5)]
        )  # fmt: skip
        bodies.append(nts.Continuum(mesh, rubber, density=1e3, velocity=thrown, name=f"at {low}"))
    slave, master = bodies[0].surface(plane(0, 1.0)), bodies[1].surface(plane(0, 1.004))
    pair = nts.ContactPair(slave, master, integration=way)
    system = nts.System(bodies, contacts=[pair])
    start = time.process_time()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.06, accuracy="balanced")
    assert run.status == "completed"
    return time.process_time() - start, int(run.balance["newton_iterations"].sum())


def main(parts: list[str], *, picture: str | None = None, rounds: int = 5) -> None:
    """Print the tables, and draw the picture."""
    if "patch" in parts:
        for kind in (CellType.hexahedron, CellType.tetrahedron):
            for cells in PATCHES:
                found = [patch(cells, kind, way) for way in WAYS]
                text = ", ".join(
                    f"{way} pressure {p:.1e} stress {s:.1e}"
                    for way, (p, s) in zip(WAYS, found, strict=True)
                )
                print(f"patch {kind.name} {cells[0]}:{cells[1]}: {text}", flush=True)
    if "coarse" in parts:
        for way in WAYS:
            print(f"coarse slave, {way}: slave, master enter by", *deepest(way), flush=True)
    if "hertz" in parts:
        of_meshes = {(cells, way): press(cells, way) for cells in MESHES for way in WAYS}
        for (cells, way), found_ in of_meshes.items():
            error, iterations = found_["error"], found_["iterations"]
            print(f"hertz {cells[0]} on {cells[1]}, {way}: {error:.2%}, {iterations} iterations")
        if picture:
            draw(of_meshes, picture)
    if "cost" in parts:
        for n in (8, 16):
            for way in WAYS:
                collide(4, way)
            ratios = []
            for _ in range(rounds):
                each = [collide(n, way) for way in WAYS]
                ratios.append(each[1][0] / each[0][0])
            iterations = [i for _, i in each]
            print(f"cost n={n}: {np.median(ratios):.2f} {ratios}, iterations {iterations}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["patch", "coarse", "hertz", "cost"])
    parser.add_argument("--picture", help="where the picture of Hertz's cylinders goes")
    parser.add_argument("--rounds", type=int, default=5, help="runs in turns of each")
    given = parser.parse_args()
    main(given.parts, picture=given.picture, rounds=given.rounds)
