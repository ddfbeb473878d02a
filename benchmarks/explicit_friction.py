"""A cube thrown on a rough plane by an explicit code of its own: what the rebound should be.

    python benchmarks/explicit_friction.py [cells ...] [--nu 0.49] [--friction 0.8]

Nothing here is of dolfinx_nts: central differences, lumped mass, trilinear hexahedra with 2^3 Gauss
points, the first Piola stress of W = mu/2 (J1 - 3) + mu/20 (J1 - 3)^2 + K/2 (J - 1)^2 with
J1 = tr C / J^(2/3) by hand, and on each node of the lower face a penalty with Coulomb's law: a
spring along the plane whose foot slides where it pulls by more than friction times the pressure.
Each row tells the balance of the run, too: work of friction included, the energy changes by little,
the momentum by the impulse of the plane.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np

SIDE, YOUNG, DENSITY, THROWN = 0.1, 1e6, 1.1e3, (1.5, 0.0, -1.0)
GAP, T_END = 0.0005, 0.014


class Rebound(NamedTuple):
    """Of the whole body at the end: velocity [m/s], spin about y [rad/s], what the balance misses.

    `lost` and `missing` are relative: energy less work of friction, and momentum less impulse.
    `rows` has time, velocity (3), spin about y and contact force (3) of some steps.
    """

    v_x: float
    v_z: float
    spin: float
    lost: float
    missing: float
    steps: int
    rows: np.ndarray[Any, Any]


class Cube:
    """Mesh, lumped mass and elastic force; x has shape (nodes, 3).

    Of an even number of cells it is the half with y < SIDE/2, by symmetry.
    """

    def __init__(self, cells: int, nu: float) -> None:
        half = cells % 2 == 0
        line, wide = np.linspace(0.0, SIDE, cells + 1), cells // 2 if half else cells
        corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        self.h = SIDE / cells
        self.mu = YOUNG / 2 / (1 + nu)
        self.bulk = YOUNG / 3 / (1 - 2 * nu)
        grid = np.stack(np.meshgrid(line, line[: wide + 1], line, indexing="ij"), axis=-1)
        self.x = grid.reshape(-1, 3) + [0.0, 0.0, GAP]
        counts = [np.arange(k) for k in (cells, wide, cells)]
        first = np.stack(np.meshgrid(*counts, indexing="ij"), axis=-1)
        strides = [(wide + 1) * (cells + 1), cells + 1, 1]
        self.cells = (first.reshape(-1, 1, 3) + corner) @ strides
        self.held = half & (self.x[:, 1] > SIDE / 2 - 1e-9)
        gauss = 0.5 + (corner - 0.5) / np.sqrt(3.0)
        factor = np.where(corner[None] == 1, gauss[:, None], 1 - gauss[:, None])
        slope = np.where(corner == 1, 1.0, -1.0) / self.h
        # Derivatives of the eight shape functions, shape (point, node, 3), the same in each cell.
        slopes = np.stack(
            [slope[:, i] * np.delete(factor, i, axis=2).prod(axis=2) for i in range(3)], axis=2
        )
        self._flat = slopes.transpose(0, 2, 1).reshape(24, 8)
        self.mass = np.bincount(self.cells.ravel()) * DENSITY * self.h**3 / 8
        self.wave = np.sqrt((self.bulk + 4 / 3 * self.mu) / DENSITY)

    def elastic(self, x: np.ndarray[Any, Any]) -> tuple[Any, float]:
        """Forces on the nodes [N], shape (nodes, 3), and the energy [J]."""
        at = x[self.cells].transpose(1, 2, 0).reshape(8, -1)
        # f[i, j] = dx_i/dX_j, each of shape (points, cells).
        f = (self._flat @ at).reshape(8, 3, 3, -1).transpose(2, 1, 0, 3).copy()
        cofactor = np.empty_like(f)
        for i in range(3):
            k, m = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                p, q = (j + 1) % 3, (j + 2) % 3
                cofactor[i, j] = f[k, p] * f[m, q] - f[k, q] * f[m, p]
        j = (f[0] * cofactor[0]).sum(axis=0)
        less = np.cbrt(j) ** -2
        square = np.einsum("ijpe,ijpe->pe", f, f)
        over, weight = less * square - 3.0, self.h**3 / 8
        by_j1 = self.mu * (0.5 + 0.1 * over)
        along = self.bulk * (j - 1) - by_j1 * less * square * (2.0 / 3.0) / j
        piola = 2 * by_j1 * less * f + along * cofactor
        energy = 0.5 * self.mu * over + 0.05 * self.mu * over**2 + 0.5 * self.bulk * (j - 1) ** 2
        on = self._flat.T @ piola.transpose(2, 1, 0, 3).reshape(24, -1)
        on = on.reshape(8, 3, -1).transpose(1, 2, 0).reshape(3, -1) * -weight
        force = [np.bincount(self.cells.ravel(), row, minlength=len(x)) for row in on]
        force[1][self.held] = 0.0
        return np.stack(force, axis=1), float(energy.sum() * weight)


def run(
    cells: int, nu: float = 0.49, friction: float = 0.8, penalty: float = 1.0, courant: float = 0.4
) -> Rebound:
    """Throw the cube.

    Args:
        cells: Along an edge.
        nu: Poisson's ratio.
        friction: Coefficient.
        penalty: Stiffness of the plane over that of a column of one cell.
        courant: Step over the time of a wave through a cell.
    """
    cube = Cube(cells, nu)
    x, v, mass = cube.x.copy(), np.tile(THROWN, (len(cube.x), 1)), cube.mass[:, None]
    dt = courant * cube.h / cube.wave / np.sqrt(max(1.0, penalty))
    low = np.flatnonzero(x[:, 2] < GAP + 1e-9)
    # The plane's stiffness on each node goes with the area that is the node's.
    stiff = penalty * cube.wave**2 * DENSITY / cube.h * cube.mass[low] / (DENSITY * cube.h / 2)
    foot, touched = x[low, :2].copy(), np.zeros(len(low), dtype=bool)
    steps, friction_work, impulse, rows = int(np.ceil(T_END / dt)), 0.0, np.zeros(3), []
    force, energy = cube.elastic(x)
    start, momentum = energy + 0.5 * float((mass * v * v).sum()), (mass * v).sum(axis=0)
    on = np.zeros((len(low), 3))
    for step in range(steps + 1):
        now = v + dt / 2 * force / mass  # v is that half a step before, but at the start
        if step % 10 == 0 or step == steps:
            rows.append(np.concatenate([[step * dt], _motion(x, now, mass), on.sum(axis=0)]))
        if step == steps:
            break
        v += dt * force / mass if step else dt / 2 * force / mass
        x = x + dt * v
        force, energy = cube.elastic(x)
        depth = np.maximum(-x[low, 2], 0.0)
        foot[(depth > 0) & ~touched] = x[low, :2][(depth > 0) & ~touched]
        touched = depth > 0
        pull = stiff[:, None] * (foot - x[low, :2])
        size, bound = np.linalg.norm(pull, axis=1), friction * stiff * depth
        part = np.minimum(1.0, bound / np.maximum(size, 1e-300))
        slid = (1 - part)[:, None] * (x[low, :2] - foot)
        foot += np.where(touched[:, None], slid, 0.0)
        on = np.column_stack([pull * part[:, None], stiff * depth])
        on[~touched] = 0.0
        friction_work += float((np.linalg.norm(slid, axis=1) * bound)[touched].sum())
        impulse += dt * on.sum(axis=0)
        force[low] += on
    impulse -= dt / 2 * on.sum(axis=0)
    stored = float((on[:, 2] ** 2 / stiff).sum() + (on[:, :2] ** 2 / stiff[:, None]).sum()) / 2
    end = energy + stored + 0.5 * float((mass * now * now).sum())
    missed = (mass * now).sum(axis=0) - momentum - impulse
    missing = float(np.abs(missed[::2]).max() / np.abs(momentum).max())
    lost = (start - end - friction_work) / start
    motion = rows[-1]
    return Rebound(motion[1], motion[3], motion[4], lost, missing, steps, np.array(rows))


def _motion(x: Any, v: Any, mass: Any) -> Any:
    """Velocity (3) of the body and its spin about y through its centre."""
    total = mass.sum()
    velocity, arm = (mass * v).sum(axis=0) / total, x - (mass * x).sum(axis=0) / total
    turning = arm[:, 2] * (v - velocity)[:, 0] - arm[:, 0] * (v - velocity)[:, 2]
    spin = (mass[:, 0] * turning).sum() / (mass * arm[:, ::2] ** 2).sum()
    return np.concatenate([velocity, [spin]])


def main() -> None:
    """Print a row for each mesh, penalty and step."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", type=int, nargs="*", default=[5, 8])
    parser.add_argument("--nu", type=float, default=0.49)
    parser.add_argument("--friction", type=float, default=0.8)
    parser.add_argument("--penalty", type=float, nargs="*", default=[1.0])
    parser.add_argument("--courant", type=float, nargs="*", default=[0.4])
    given = parser.parse_args()
    print("cells penalty courant   v_x   v_z  spin  energy lost  momentum missing  steps")
    for n in given.cells:
        for penalty in given.penalty:
            for courant in given.courant:
                r = run(n, given.nu, given.friction, penalty, courant)
                print(f"{n:5} {penalty:7g} {courant:7g} {r.v_x:5.3f} {r.v_z:5.3f} {r.spin:5.2f}"
                      f"  {r.lost:11.1e} {r.missing:17.1e} {r.steps:6}")  # fmt: skip


if __name__ == "__main__":
    main()
