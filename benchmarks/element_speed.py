"""Pairs per second of the contact element: residual and exact tangent together, on one core."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from dolfinx_nts.kernels import facets, nts_element, patches


def middle_patch() -> np.ndarray:
    """Control points of the patch in the middle of 3 x 3 squares with edge 2, shape (16, 3)."""
    line = np.arange(-3.0, 4.0, 2.0)
    x = np.array([(s, t, 0.0) for s in line for t in line])
    first = np.array([4 * i + j for i in range(3) for j in range(3)])
    squares = first[:, None] + [0, 4, 5, 1]
    points, _, _ = patches.control_net(squares, x[squares])
    patch: np.ndarray = x[points[4]]
    return patch


def pairs(n: int, nc: int = 4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States at t_n and t_{n+1} and multipliers of n pairs on warped quadrilaterals or patches."""
    rng = np.random.default_rng(0)
    corners = middle_patch()[:nc] + 0.1 * rng.normal(size=(n, nc, 3))
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
    print(
        f"{'pairs':>8}{'mean-value':>14}{'gonzalez':>14}{'midpoint':>14}{'smoothing':>14}   pairs/s"
    )
    for n in options.pairs:
        z0, z1, multiplier = pairs(n)
        x, xi = z1[:, :15].reshape(n, 5, 3), z0[:, -2:]

        def direct(x: np.ndarray = x, xi: np.ndarray = xi) -> None:
            """The midpoint rule needs the gap at the middle and at the end."""
            for _ in range(2):
                nts_element.gap(x, facets.project(x[:, 0], x[:, 1:], xi)[0])

        def element(
            rule: str, z0: np.ndarray = z0, z1: np.ndarray = z1, m: np.ndarray = multiplier
        ) -> object:
            return nts_element.element(z0, z1, m, rule)

        rates = [
            rate(lambda r=r: element(r), n, options.seconds) for r in ("mean-value", "gonzalez")
        ]
        rates.append(rate(direct, n, options.seconds))
        smooth = pairs(n, patches.NUM_POINTS)
        patched = lambda a=smooth: nts_element.element(*a, "mean-value")  # noqa: E731
        rates.append(rate(patched, n, options.seconds))
        print(f"{n:>8}" + "".join(f"{r:14.0f}" for r in rates), flush=True)


if __name__ == "__main__":
    main()
