"""How stiff what acts between bodies is, such as springs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dolfinx_nts.arrays import FloatArray
from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import evaluate_together


def stiffness_between(
    batches: Batches,
    laid: Unknowns,
    elements: Sequence[Any],
    bodies: Sequence[tuple[int, ...]],
    u: Sequence[FloatArray],
) -> FloatArray:
    """Norm of the stiffness of elements without own unknowns, of each body [kg]. Collective.

    Args:
        batches: Of bodies.
        laid: Layout of the unknowns.
        elements: Batches of elements.
        bodies: Numbers of the bodies of each batch.
        u: Owned displacements of each batch of bodies [m].

    Returns:
        Shape (bodies,); [N/m] in statics.
    """
    local, start = np.zeros(batches.count), laid.x.duplicate()
    start.set(0.0)
    laid.write(u, start.array_w)
    positions = laid.positions(start, elements)
    own = laid.own_values(start.array_r, elements)
    start.destroy()
    chosen = [i for i, batch in enumerate(elements) if not any(batch.widths.values())]
    parts = evaluate_together(
        laid.layout.comm,
        [elements[i] for i in chosen],
        [positions[i] for i in chosen],
        [own[i] for i in chosen],
    )
    for i, part in zip(chosen, parts, strict=True):
        first = 0
        for k, dofs in zip(bodies[i], elements[i].dofs(), strict=True):
            stop = first + dofs.shape[1]
            along = part.tangent[:, first:stop, first:stop].diagonal(axis1=1, axis2=2)
            free = dofs >= 0
            np.add.at(local, batches.body_of(k, dofs[free]), np.square(along[free]))
            first = stop
    found: FloatArray = np.sqrt(laid.layout.comm.allreduce(local))
    return found
