"""How far neighbouring nodes of beams and shells turn, and what their elements feel of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from dolfinx_nts.types import FloatArray, IntArray

#: Turn between neighbouring nodes [rad] from which on failed steps name it.
NAMED = np.pi / 6.0
#: Moment of a bent element over the right one below which a run warns, that of a beam of two nodes
#: at 15 degrees, and what the elements have that a message asks for. Rounding must not tell an axis
#: that turns by just this.
TOLD, RESOLVED = 3.0 / np.pi - 1e-9, 0.97

#: Turn that the strains of an element feel [rad], and its slope, from that between its nodes [rad].
Felt = Callable[[float], tuple[float, float]]


def moments(felt: Felt, turn: float) -> tuple[float, float]:
    """Moment of an element over the right one, bent by so much, and a little on from there."""
    found, slope = felt(turn)
    return found * slope / turn, slope**2


def that_leaves(felt: Felt, part: float) -> float:
    """Turn between neighbouring nodes that leaves this part of a straight one's moment [rad]."""
    return float(brentq(lambda turn: moments(felt, turn)[0] - part, 1e-3, 0.5 * np.pi))


def described(felt: Felt, what: str, cosine: float, place: FloatArray) -> tuple[str, float]:
    """What `least_cosine` at a place means, and how many times as many elements are needed."""
    turn = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    bent = min(turn, 0.5 * np.pi)
    straight, arc = (100.0 * (1.0 - part) for part in moments(felt, bent))
    x = ", ".join(f"{c:.4g}" for c in place)
    text = (
        f"{what} turns by {np.degrees(turn):.3g} degrees between neighbouring nodes near X = "
        f"({x}): too easy to bend by {straight:.0f} % if it was straight, by {arc:.0f} % if it was "
        "an arc like this"
    )
    return text, bent / that_leaves(felt, RESOLVED)


def least_cosine(directors: FloatArray, pairs: IntArray) -> tuple[float, int, IntArray]:
    """Smallest cosine of the turn between neighbouring nodes, its element and its pair.

    Args:
        directors: Of the elements' nodes [m], shape (n, nodes, directors, 3), n > 0.
        pairs: Nodes that are neighbours, shape (p, 2).

    Returns:
        The cosine, -inf where it is no number, the element and both nodes.
    """
    count = directors.shape[2]
    flat = directors.reshape(*directors.shape[:2], 3 * count)
    size = np.linalg.norm(flat, axis=2)
    a, b = pairs.T
    cosine = np.einsum("npk,npk->np", flat[:, a], flat[:, b])
    cosine /= size[:, a] * size[:, b]
    i = int(cosine.argmin())  # the first NaN, if there is one
    least = float(cosine.flat[i])
    if count > 1:
        # Products of three directors are 1 + 2 cos of their turn, in terms of one.
        least = 1.5 * least - 0.5
    element, pair = divmod(i, len(pairs))
    return least if np.isfinite(least) else -np.inf, element, pairs[pair]
