"""Pairs per second of the contact element: residual and exact tangent together, on one core."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from dolfinx_nts import facets, nts


def pairs(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States at t_n and t_{n+1} and multipliers of n pairs on warped quadrilaterals."""
    rng = np.random.default_rng(0)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    corners = corners + 0.1 * rng.normal(size=(n, 4, 3))
    slave = 0.2 * rng.normal(size=(n, 3))
    xi, _ = facets.project(slave, corners, np.zeros((n, 2)))
    normal = facets.frame(corners, xi)[2]
    z0 = np.concatenate([slave, corners.reshape(n, -1), normal, xi], axis=1)
    return z0, z0 + 0.01 * rng.normal(size=z0.shape), rng.normal(size=(n, 6))


def rate(work: Callable[[], object], n: int, seconds: float) -> float:
    """Pairs per second of a piece of work on n pairs."""
    work()
    begin, count = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        work()
        count += 1
    return count * n / (time.perf_counter() - begin)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, nargs="+", default=[300, 3000, 30000])
    parser.add_argument("--seconds", type=float, default=1.0, help="time per figure")
    options = parser.parse_args()
    print(f"{'pairs':>8}{'mean-value':>14}{'gonzalez':>14}{'midpoint':>14}   pairs/s")
    for n in options.pairs:
        z0, z1, multiplier = pairs(n)
        x, xi = z1[:, :15].reshape(n, 5, 3), z0[:, -2:]

        def direct(x: np.ndarray = x, xi: np.ndarray = xi) -> None:
            """The midpoint rule needs the gap at the middle and at the end."""
            for _ in range(2):
                nts.gap(x, facets.project(x[:, 0], x[:, 1:], xi)[0])

        def element(
            rule: str, z0: np.ndarray = z0, z1: np.ndarray = z1, m: np.ndarray = multiplier
        ) -> object:
            return nts.element(z0, z1, m, rule)

        rates = [
            rate(lambda r=r: element(r), n, options.seconds) for r in ("mean-value", "gonzalez")
        ]
        rates.append(rate(direct, n, options.seconds))
        print(f"{n:>8}" + "".join(f"{r:14.0f}" for r in rates), flush=True)


if __name__ == "__main__":
    main()
