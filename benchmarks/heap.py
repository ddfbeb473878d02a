"""A heap: rigid cubes and balls with friction fall into a box without a lid, every two a contact.

    python benchmarks/heap.py [--bodies 10 40 100] [--friction 0.4] [--t-end 0.2]
                             [--dt 2e-3] [--rest]

Cubes (edges of 0.09 to 0.1) and balls of 24 facets (diameter 0.1) alternate. They start in layers,
0.2 apart, turned at random. Printed are the time to make the scene and the run, a step's in free
flight and in the mean, Newton iterations, cut steps, the deepest vertex of any body inside a cube
(by half spaces, apart from the package), what the ledger misses over the largest energy, and the
kinetic energy at the end over the work of gravity. `--rest` takes `GeneralizedAlpha(rho_inf=0.5)`
in place of `EnergyMomentum`.
"""

import argparse
import time

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts

SIZE, APART, GRAVITY = 0.1, 0.2, 9.81


def shape(comm, ball, size, turn, centre):
    """Mesh of a cube, or of one whose nodes are on a sphere."""
    n, half = (2, 1.0) if ball else (1, 0.5)
    mesh = create_box(
        comm, [[-half] * 3, [half] * 3], [n] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x = mesh.geometry.x
    if ball:
        far = np.linalg.norm(x, axis=1, keepdims=True)
        x *= 0.5 * np.abs(x).max(axis=1, keepdims=True) / np.where(far > 0.0, far, 1.0)
    x[:] = size * x @ turn.T + centre
    return mesh


def scene(comm, bodies, friction, seed=0):
    """The bodies in layers over the floor, every two of them a contact, and the walls."""
    rng = np.random.default_rng(seed)
    side = max(2, round((bodies / 2) ** (1 / 3)))
    found = []
    for k in range(bodies):
        layer, (row, column) = k // side**2, divmod(k % side**2, side)
        shift = rng.uniform(-0.01, 0.01, 3)
        centre = APART * np.array([column + 0.5, row + 0.5, layer + 0.7]) + shift
        turn = Rotation.random(random_state=rng).as_matrix()
        size = SIZE * rng.uniform(0.9, 1.0)
        mesh = shape(comm, bool(k % 2), size, turn, centre)
        found.append(nts.RigidBody(mesh, density=1e3, name=f"body {k}"))
    skins = [body.surface(lambda x: np.full(x.shape[1], True)) for body in found]
    wide = APART * side
    walls = [
        nts.Plane((0, 0, 0), (0, 0, 1), name="floor"),
        *(nts.Plane((0, 0, 0), n, name=f"wall {n}") for n in ((1, 0, 0), (0, 1, 0))),
        *(nts.Plane((wide, wide, 0), n, name=f"wall {n}") for n in ((-1, 0, 0), (0, -1, 0))),
    ]
    contacts = [nts.ContactPair(s, wall, friction=friction) for wall in walls for s in skins]
    contacts += [
        nts.ContactPair(a, b, friction=friction) for k, a in enumerate(skins) for b in skins[:k]
    ]
    return nts.System(found, contacts=contacts, gravity=(0, 0, -GRAVITY))




def depth(system):
    """Of the deepest vertex of any body inside a cube [m]; faces of balls bow."""
    places = [
        (body.mesh.geometry.x - body.centre) @ body.rotation.T + body.position
        for body in system.bodies
    ]
    deepest = 0.0
    for k in range(0, len(places), 2):
        faces = ConvexHull(places[k]).equations
        for j, x in enumerate(places):
            if j != k:
                inside = -(x @ faces[:, :3].T + faces[:, 3]).max(axis=1)
                deepest = max(deepest, float(inside.max()))
    return deepest


def main(bodies, friction=0.4, t_end=0.2, dt=2e-3, rest=False, progress=False):
    """One heap."""
    begin = time.process_time()
    system = scene(MPI.COMM_WORLD, bodies, friction)
    stepper = nts.Stepper(
        system, nts.GeneralizedAlpha(rho_inf=0.5) if rest else nts.EnergyMomentum()
    )
    stepper.advance(dt)
    made, times, deepest = time.process_time() - begin, [], 0.0
    while stepper.state.time < t_end - 0.5 * dt:
        begin = time.process_time()
        stepper.advance(dt)
        times.append(time.process_time() - begin)
        deepest = max(deepest, depth(system))
        if progress:
            print(f"{stepper.state.time:.4f} s: {1e3 * times[-1]:.1f} ms", flush=True)
    table = stepper.solution.balance
    top = max(np.abs(table[name]).max() for name in ("kinetic", "external_work"))
    return {
        "made": made, "flight": min(times), "mean": float(np.mean(times)),
        "iterations": float(table["newton_iterations"][1:].mean()),
        "most": int(table["newton_iterations"].max()), "retries": stepper.solution.retries,
        "touching": int(table["active"].max()), "depth": deepest,
        "unrest": float(table["kinetic"][-1] / table["external_work"][-1]),
        "ledger": float(np.abs(table["ledger_residual"]).max() / top),
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, nargs="+", default=[10, 40])
    parser.add_argument("--friction", type=float, default=0.4)
    parser.add_argument("--t-end", type=float, default=0.2, help="[s]")
    parser.add_argument("--dt", type=float, default=2e-3, help="[s]")
    parser.add_argument("--rest", action="store_true")
    parser.add_argument("--progress", action="store_true")
    options = vars(parser.parse_args())
    for number in options.pop("bodies"):
        found = main(number, **options)
        print(f"{number} bodies:", *(f"{k} {v:.3g}" for k, v in found.items()), flush=True)
