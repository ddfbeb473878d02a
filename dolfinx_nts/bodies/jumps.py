"""Prescribed values that do not begin where the nodes lie."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from dolfinx_nts.parallel import global_max

#: Part of a body's size beyond which its supports count as moved at once.
_FAR = 1e-3


def jumps(bodies: Iterable[Any]) -> str:
    """Which supports move a part of their body at once, and what to do, or nothing. Collective.

    A constant value holds from the start on, so that no smaller step divides its motion.

    Args:
        bodies: In the order of all ranks. A body to whose nodes the user has given displacements
            starts as meant, and a rigid one moves as a whole.
    """
    found = []
    for body in bodies:
        if body.rigid or body.starts_moved:
            continue
        x = body.reference.reshape(-1, 3)[body.places]
        high, low = x.max(axis=0, initial=-np.inf), x.min(axis=0, initial=np.inf)
        # Directors follow their place.
        places = np.repeat(body.places, 3)[body.fixed]
        far = np.abs(body.prescribed(0.0)[places]).max(initial=0.0)
        *spread, jump = global_max(body.comm, np.concatenate([high, -low, [far]]))
        if jump > _FAR * float(np.max(np.add(spread[:3], spread[3:]))):
            found.append(
                f"supports of {body.name!r} move by {jump:.3g} at once, at the start: make that "
                "value a function of t that begins at 0, e.g. Dirichlet(where, lambda t: ...)"
            )
    return "; ".join(found)
