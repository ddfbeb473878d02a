"""The elements of beams and shells on a rank: what their mass and their strains make in a step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from dolfinx_nts.bodies.slender.element_values import ElementValues
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.types import FloatArray


class DirectorElements:
    """This rank's elements; `begin` fixes the step.

    Args:
        values: Takes nodal vectors to the elements, and sums up what these contribute.
        strained: Their strains and stiffness.
        rest: Nodal vectors in the reference [m], shape (n, k, 3).
        shares: int N_a N_b of their nodes [m or m^2], shape (n, nodes, nodes).
        masses: Per length or area, of the place and of the directors, shape (vectors,).

    Attributes:
        y0: Nodal vectors at t_n [m], after `begin`, shape (n, k, 3).
        theta: Where forces are taken, see `kernel.force`.
    """

    def __init__(
        self, values: ElementValues, strained: kernel.Elements, rest: FloatArray,
        shares: FloatArray, masses: FloatArray,
    ) -> None:  # fmt: skip
        self.values, self.strained, self.rest = values, strained, rest
        self.shares, self.masses = shares, masses

    @classmethod
    def together(
        cls, parts: Sequence[DirectorElements], values: ElementValues
    ) -> DirectorElements:
        """Those of several bodies with the same masses, one after the other."""
        each = zip(*(part.strained for part in parts), strict=True)
        rest, shares = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("rest", "shares")
        )
        strained = kernel.Elements(*map(np.concatenate, each))
        return cls(values, strained, rest, shares, parts[0].masses)

    def begin(self, u0: FloatArray, theta: float | None) -> None:
        """Fix the displacement at t_n [m], and where forces are taken. Collective."""
        self.y0: FloatArray = self.vectors(u0)
        self.theta: float | None = theta

    def vectors(self, u: FloatArray) -> FloatArray:
        """Nodal vectors of this rank's elements [m], shape (n, k, 3). Collective."""
        return self.rest + self.values.of(u)

    @cached_property
    def nodal_mass(self) -> FloatArray:
        """Sums of the mass matrix at this rank's coordinates [kg]. Collective."""
        n, nodes = self.shares.shape[:2]
        sums = self.shares.sum(axis=2)[:, :, None, None] * self.masses[:, None]
        return self.values.sums(np.broadcast_to(sums, (n, nodes, len(self.masses), 3)))

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]. Collective."""
        n, nodes = self.shares.shape[:2]
        at = self.values.of(v).reshape(n, nodes, 3 * len(self.masses))
        return self.values.sums(np.matmul(self.shares, at) * np.repeat(self.masses, 3))

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]. Collective."""
        found = kernel.force(self.strained, self.y0, self.vectors(u1), self.theta)
        return self.values.sums(found)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> FloatArray:
        """Return mass M + stiffness K of each element, shape (n, 3 k, 3 k). Collective."""
        if stiffness:
            found = kernel.tangent(self.strained, self.y0, self.vectors(u1), self.theta)
            found *= stiffness
        else:
            n, k, _ = self.rest.shape
            found = np.zeros((n, 3 * k, 3 * k))
        if mass:
            of_vectors = mass * self._mass
            for i in range(3):
                found[:, i::3, i::3] += of_vectors
        return found

    @cached_property
    def _mass(self) -> FloatArray:
        """Mass matrices, of one component of the nodal vectors, (n, k, k)."""
        k, (n, nodes) = len(self.masses), self.shares.shape[:2]
        whole = np.zeros((n, nodes, k, nodes, k))
        each = np.einsum("nab,k->knab", self.shares, self.masses)
        whole[:, :, range(k), :, range(k)] = each
        return whole.reshape(n, nodes * k, nodes * k)

    @cached_property
    def diagonal(self) -> FloatArray:
        """Diagonal of the stiffness in the reference at this rank's nodes [N/m]. Collective."""
        k = kernel.tangent(self.strained, self.rest, self.rest, 1.0)
        return self.values.sums(np.einsum("nii->ni", k))

    def nodal_stiffness(self) -> FloatArray:
        """Mean of `diagonal` at each nodal vector [N/m]. Collective."""
        return np.repeat(self.diagonal.reshape(-1, 3).mean(axis=1), 3)

    def potential(self, u: FloatArray) -> float:
        """Strain energy on this rank [J]. Collective."""
        return float(kernel.energy(self.strained, self.vectors(u)).sum())
