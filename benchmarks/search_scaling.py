"""Cost of the closest-facet search: points against as many facets, and against n log n.

Run as `python benchmarks/search_scaling.py [--max 100000] [--repeat 3] [--gap 0.1]`.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from dolfinx_nts.contact.search import closest_facets


def wavy_surface(n: int) -> np.ndarray:
    """About n warped quadrilaterals with edges of about 1 [m], shape (m, 4, 3)."""
    cells = max(1, round(math.sqrt(n)))
    x, y = np.meshgrid(np.arange(cells + 1.0), np.arange(cells + 1.0), indexing="ij")
    grid = np.stack([x, y, np.sin(0.3 * x) * np.cos(0.2 * y)], axis=2)
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
    return corners.reshape(-1, 4, 3)


def main(largest: int = 100_000, repeat: int = 3, gap: float = 0.1) -> list[tuple[int, float]]:
    """Print the table; return n and the best time [s] of each row."""
    rng = np.random.default_rng(0)
    rows = []
    print(f"{'n':>8} {'time [s]':>10} {'time/(n log2 n) [ns]':>22}")
    n = 1000
    while n <= largest:
        corners = wavy_surface(n)
        points = corners.mean(axis=1)
        points += rng.uniform(-0.5, 0.5, points.shape) * [1.0, 1.0, 2.0 * gap]
        best = math.inf
        for _ in range(repeat):
            start = time.perf_counter()
            closest_facets(points, corners, reach=1.0)
            best = min(best, time.perf_counter() - start)
        rows.append((len(points), best))
        size = len(points)
        print(f"{size:8d} {best:10.4f} {1e9 * best / (size * math.log2(size)):22.1f}")
        n = round(n * math.sqrt(10.0))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--max", type=int, default=100_000, help="largest number of points")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each size, the best counts")
    parser.add_argument("--gap", type=float, default=0.1, help="largest offset from the facets [m]")
    arguments = parser.parse_args()
    main(arguments.max, arguments.repeat, arguments.gap)
