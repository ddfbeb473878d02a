"""Points of a master that a rank needs: those of facets near its slaves. Counted on plain grids.

    python benchmarks/surface_parts.py

Two square surfaces of n and n + 1 cells along their edges touch; the reach is a cell. Slaves are
dealt to ranks by the hash that `Surface.share` goes by, or by place: halved again and again across
the longer side. The master's points lie on ranks by place. No MPI is needed.
"""

from __future__ import annotations

import numpy as np

from dolfinx_nts.contact.surfaces import _rank_of


def grid(n: int) -> np.ndarray:
    """Points of n x n cells of a unit square, ((n + 1)^2, 2)."""
    line = np.arange(n + 1) / n
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)


def halved(x: np.ndarray, ranks: int) -> np.ndarray:
    """Ranks of points (n, 2) by place, equally many points each, shape (n,)."""
    of, parts = np.zeros(len(x), dtype=int), [(np.arange(len(x)), 0, ranks)]
    while parts:
        here, first, number = parts.pop()
        of[here] = first
        if number > 1:
            left = number // 2
            order = here[x[here, np.ptp(x[here], axis=0).argmax()].argsort(kind="stable")]
            k = len(order) * left // number
            parts += (order[:k], first, left), (order[k:], first + left, number - left)
    return of


def needed(slaves: np.ndarray, n: int) -> np.ndarray:
    """Which points of a master of n x n cells belong to cells within reach of slaves, mask."""
    cells = np.zeros((n, n), dtype=bool)
    low = np.clip(np.floor(slaves * n - 1.0), 0, n - 1).astype(int)
    high = np.clip(np.floor(slaves * n + 1.0), 0, n - 1).astype(int)
    for (a, b), (c, d) in zip(low, high, strict=True):
        cells[a : c + 1, b : d + 1] = True
    points = np.zeros((n + 1, n + 1), dtype=bool)
    for i, j in np.ndindex(2, 2):
        points[i : n + i, j : n + j] |= cells
    return points.ravel()


def main() -> None:
    """Print the largest part of the master's points that a rank needs, and of how many ranks."""
    print("slaves  ranks  by hash: part, ranks  by place: part, ranks")
    for n in (24, 400):
        slaves, owners = grid(n), grid(n + 1)
        for ranks in (2, 4, 8, 16, 64):
            holds, row = halved(owners, ranks), []
            for of in (_rank_of(np.arange(len(slaves)), ranks), halved(slaves, ranks)):
                seen = [needed(slaves[of == k], n + 1) for k in range(ranks)]
                row += [max(s.mean() for s in seen), max(len(set(holds[s])) for s in seen)]
            part, number, part_by_place, number_by_place = row
            print(
                f"{len(slaves):6d}  {ranks:5d}  {part:13.1%}  {number:5d}  "
                f"{part_by_place:14.1%}  {number_by_place:5d}"
            )


if __name__ == "__main__":
    main()
