"""Where functions of a line are highest that change by no more than the way along it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dolfinx_nts.types import FloatArray, IntArray

#: What may hold a higher value is divided so many times into so many parts, until the highest is
#: known to this part of it.
_ROUNDS, _PARTS, _PRECISE = 7, 4, 0.01


def highest(
    value: Callable[[IntArray, FloatArray, FloatArray], FloatArray],
    start: FloatArray,
    length: FloatArray,
    limit: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return where functions of s in [0, 1] are highest, whose slope is at most the length.

    Args:
        value: Values (k,) of functions (k,) at s (k,); values below minus the third argument (k,)
            need not be known and may be -inf.
        start: Values at s = 0 and s = 1, shape (n, 2).
        length: Largest slope of each, shape (n,).
        limit: Value of interest, shape (n,).

    Returns:
        Place (n,) and value (n,) of the highest point, to one part in a hundred of the value; where
        none is as high as the limit, of some point.
    """
    line, s, d = np.arange(len(start)), np.tile([0.0, 1.0], (len(start), 1)), start
    place, best = np.argmax(start, axis=1).astype(np.float64), start.max(axis=1)
    for _ in range(_ROUNDS):
        way = (s[:, 1] - s[:, 0]) * length[line]
        known = np.maximum(limit, (1.0 + _PRECISE) * best)[line]
        open_ = np.flatnonzero(d.sum(axis=1) + way > 2.0 * known)
        if not open_.size:
            break
        line, s, d, way = line[open_], s[open_], d[open_], way[open_]
        at = s[:, :1] + np.linspace(0.0, 1.0, _PARTS + 1) * (s[:, 1:] - s[:, :1])
        of, inner = np.repeat(line, _PARTS - 1), at[:, 1:-1].ravel()
        reach = np.maximum(d.max(axis=1), limit[line]) + 0.5 * way
        found = value(of, inner, np.repeat(reach, _PARTS - 1))
        order = np.lexsort((-found, of))
        first = order[np.unique(of[order], return_index=True)[1]]
        better = first[found[first] > best[of[first]]]
        place[of[better]], best[of[better]] = inner[better], found[better]
        known_at = np.column_stack([d[:, 0], found.reshape(-1, _PARTS - 1), d[:, 1]])
        s, d = (np.stack([v[:, :-1], v[:, 1:]], axis=-1).reshape(-1, 2) for v in (at, known_at))
        line = np.repeat(line, _PARTS)
    return place, best
