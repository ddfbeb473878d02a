"""How the contact forces of rigid bodies share a load that more nodes carry than are needed.

Gaps of a rigid box on a plane repeat each other from the fourth node on: of its contact forces only
the resultants on each body act. Newton's matrix lends gaps a compliance (`constraints.SHIFT`), so
that a part of the forces in the null space would be the rounding of the gaps over the compliance.
Here the equations of the gaps say there that this part is zero, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_laws import Contribution

FloatArray = npt.NDArray[np.float64]

#: Square of the singular values that count as zero, over that of the largest.
_NONE = 1e-12
#: Solves by least squares, each for what that threshold has left of the one before.
_PASSES = 3


def _is_rigid(pair: Any) -> bool:
    """Whether it is one of rigid bodies, with each other or with an obstacle."""
    return all(body.rigid for body in pair.bodies)


class SharedWeight:
    """Gaps of rigid bodies without what is redundant in them.

    Args:
        comm: MPI communicator.
        contacts: Contacts of the scene.
        bodies: Numbers of the bodies of each of them.
    """

    def __init__(
        self, comm: Any, contacts: Sequence[Any], bodies: Sequence[tuple[int, ...]]
    ) -> None:
        both = zip(contacts, bodies, strict=True)
        rigid = sorted({k for pair, numbers in both if _is_rigid(pair) for k in numbers})
        self._comm = comm
        self._place = {k: i for i, k in enumerate(rigid)}

    def divide(
        self,
        elements: Sequence[ContactElements],
        bodies: Sequence[tuple[int, ...]],
        parts: Sequence[Contribution],
        places: Sequence[FloatArray],
    ) -> None:
        """Write the rows of active gaps anew, (1 - P) g - c P lambda = 0. Collective.

        P projects on the null space of what forces along the normals push the bodies with at
        t_{n+1}, c is the compliance that the matrix lends. As c stands in the matrix, too, the
        iteration takes P lambda out, and the gaps close as without it: P g vanishes with the rest.

        Args:
            elements: Batches of contacts.
            bodies: Numbers of their bodies.
            parts: Their contributions at an iterate, whose residuals are changed.
            places: Nodes of the batches [m], as of `Elements.evaluate`.
        """
        if not self._place:
            return
        found, pushes, values = [], [], []
        for batch, numbers, part, x in zip(elements, bodies, parts, places, strict=True):
            if not _is_rigid(batch.pair):
                continue
            on, row = np.flatnonzero(part.active), batch.gap_row
            scale = batch.scale[on]
            push = np.zeros((len(on), len(self._place), 6))
            for k, wrench in zip(numbers, batch.wrenches(part, x, on), strict=True):
                push[:, self._place[k]] += wrench
            lent = -part.tangent[on, row, row] / scale**2
            found.append((part, on, row, scale, lent))
            pushes.append(push.reshape(len(on), 6 * len(self._place)))
            values.append(np.column_stack([part.residual[on, row] / scale, part.multiplier[on, 0]]))
        g, v = np.concatenate(pushes), np.concatenate(values)
        null = v - g @ self._least_squares(g, v)
        start = 0
        for part, on, row, scale, lent in found:
            none = null[start : start + len(on)]
            part.residual[on, row] -= scale * (none[:, 0] + lent * none[:, 1])
            start += len(on)

    def _least_squares(self, g: FloatArray, v: FloatArray) -> FloatArray:
        """Motions of the bodies whose gaps g y fit some values v best. Collective."""
        size, count = g.shape[1], v.shape[1]
        sums = self._comm.allreduce(g.T @ np.concatenate([g, v], axis=1))
        # Turns in the length that makes their gaps as large as those of translations.
        square = sums.diagonal().reshape(-1, 2, 3).sum(axis=2)
        unit = np.zeros((len(square), 2, 3))
        on = square > 0.0
        unit[on] = np.sqrt(square[:, :1] / np.where(on, square, 1.0))[on][:, None]
        unit = unit.reshape(size, 1)
        a, b = unit * sums[:, :size] * unit.T, unit * sums[:, size:]
        near = np.linalg.inv(a + (_NONE * a.diagonal().max() or 1.0) * np.eye(size))
        best = np.zeros((size, count))
        for _ in range(_PASSES):
            best += near @ (b - a @ best)
        return unit * best
