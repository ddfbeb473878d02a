"""How far pressure waves run in a body while shear ones pass its layer without mass.

The friction of an impact is made in a layer as thick as a shear wave comes while the pressure that
presses it on goes through the body. Cells that are thicker take too little of it where their nodes
have no mass, and too much where they have.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dolfinx_nts.arrays import BoolArray, FloatArray
from dolfinx_nts.parallel import global_sum

#: Strain in which energies are taken as quadratic.
_STRAIN = 1e-4


def waves(
    potential: Callable[[FloatArray], float],
    x: FloatArray,
    mass: FloatArray,
    massless: BoolArray,
    comm: Any,
) -> tuple[float, float]:
    """Thickness of the layer over the body's, and speed of pressure waves over shear ones.

    From energies of uniform strains of the body, summed over the axes, and of translations of the
    massless nodes; both as if the body was a block of one material. Collective.

    Args:
        potential: Strain energy on this rank [J] by displacements of its nodes (n, 3) [m].
        x: Reference positions [m], shape (n, 3).
        mass: Row sums of the consistent mass [kg], shape (n,).
        massless: Nodes that have lost theirs, shape (n,).
        comm: Communicator.
    """
    total = float(global_sum(comm, np.array([mass.sum()]))[0])
    arm = x - global_sum(comm, mass @ x) / total
    moments = np.linalg.eigvalsh(global_sum(comm, (arm * mass[:, None]).T @ arm))
    # The thinnest way through a block; a node of the layer has the mass of half a cell.
    size = np.sqrt(12.0 * moments[0] / total)
    taken = float(global_sum(comm, np.array([mass[massless].sum()]))[0])
    axes, on = np.eye(3), massless[:, None]
    pressed = sum(_stiffness(potential, np.outer(arm[:, k], axes[k])) for k in range(3))
    sheared = sum(_stiffness(potential, np.outer(arm[:, k], axes[k - 1])) for k in range(3))
    moved = sum(_stiffness(potential, size * on * axes[k]) for k in range(3)) / size**2
    of_all = global_sum(comm, np.array([pressed, sheared, moved]))
    pressed, sheared, moved = of_all / [3.0, 3.0, 1.0]
    # NaN of a body that resists no shear, or whose energy has no value at rest: nothing is told.
    with np.errstate(divide="ignore", invalid="ignore"):
        thickness = np.sqrt(2.0 * taken / moved * (pressed + 2.0 * sheared) / total)
        speeds = np.sqrt(pressed / sheared)
    return float(thickness / size), float(speeds)


def _stiffness(potential: Callable[[FloatArray], float], u: FloatArray) -> float:
    """Twice the quadratic part of the energy of a displacement on this rank."""
    u = _STRAIN * u
    rest = potential(np.zeros_like(u))
    return (potential(u) + potential(-u) - 2.0 * rest) / _STRAIN**2
