"""Contact between two surfaces: which slaves may touch which facet, and what they contribute.

A `ContactPair` is part of the scene and holds no history; a `ContactStep` lives for one step. Both
integrators share it: the midpoint rule has one unknown per candidate (lambda_N), the
energy-momentum scheme eleven (d, f and six multipliers).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dolfinx_nts import facets, nts, patches, search
from dolfinx_nts.surfaces import Surface
from dolfinx_nts.validation import known_options

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]

#: Part of a facet's size by which a slave may penetrate at the start of a run.
INITIAL_PENETRATION = 0.01
#: A node may project this far (in convective coordinates) beyond an edge that the master surface
#: ends at ...
_OVERHANG = 0.05
#: ... and this far beyond an edge shared with another facet, between the normal cones of a convex
#: edge, and further by what the node may be away.
_WEDGE = 0.5
#: Candidates are sought this part of a facet beyond the reach of the step's motion.
_MARGIN = 0.5


class Candidates(NamedTuple):
    """Slave nodes that may touch in a step, one facet each; axis 0 = pair.

    Attributes:
        node: Positions in the slave surface's `owned`, shape (n,).
        facet: Facets of the master surface, shape (n,).
        xi: Orthogonal projection at t_n, shape (n, 2).
        normal: Outward unit normal of the master there, shape (n, 3).
        gap: g_0 [m], shape (n,).
        length: Size of the facet [m], shape (n,).
    """

    node: IntArray
    facet: IntArray
    xi: FloatArray
    normal: FloatArray
    gap: FloatArray
    length: FloatArray


@known_options
class ContactPair:
    """Slave nodes of one surface must not penetrate the facets of another (19)-(21).

    Args:
        slave: Surface whose nodes are kept outside.
        master: Surface whose facets keep them outside.
        friction: Coulomb's coefficient [-]; this version knows 0 only.

    Raises:
        TypeError: An argument is not a Surface.
        NotImplementedError: friction is not 0.
        ValueError: The surfaces share nodes.
    """

    def __init__(self, slave: Surface, master: Surface, *, friction: float = 0.0) -> None:
        if friction != 0.0:
            raise NotImplementedError(
                f"friction={friction!r}: this version has frictionless contact; pass 0 or leave it"
            )
        for name, value in (("slave", slave), ("master", master)):
            if not isinstance(value, Surface):
                raise TypeError(f"{name}={value!r}: pass a Surface, e.g. body.surface(marker)")
        if slave.body is master.body and np.intersect1d(slave.points, master.points).size:
            raise ValueError(
                f"slave, master: both surfaces of {slave.body.name!r} share nodes; "
                "choose disjoint markers"
            )
        self.slave, self.master = slave, master
        self._free_edges = master.boundary_edges
        self._joined = patches.neighbours(master.facets, master.reference[master.facets])

    @property
    def name(self) -> str:
        """Slave and master body, for messages and files."""
        return f"{self.slave.body.name}-{self.master.body.name}"

    def find(
        self,
        slave_u: FloatArray,
        master_u: FloatArray,
        current: IntArray,
        reach: float,
        ahead: tuple[FloatArray, FloatArray] | None = None,
    ) -> Candidates:
        """Search for this rank's candidates; every rank must call it.

        Args:
            slave_u: Owned displacements of the slave body [m].
            master_u: Owned displacements of the master body [m].
            current: Facet of each owned slave node in the last step or -1.
            reach: Bound on the relative motion of slave and master in the step [m].
            ahead: Displacements of both bodies expected until the middle of the step [m].
        """
        master = self.master.positions(master_u)
        corners = master[self.master.facets]
        x = self.slave.positions(slave_u)[self.slave.owned]
        radius = reach + _MARGIN * float(facets.size(corners).max())
        closest = search.closest_facets(x, corners, reach=radius, current=current)
        node = np.flatnonzero(closest.facet >= 0)
        found = self._measure(x, master, node, closest.facet[node], closest.xi[node], reach)
        if ahead is None:
            return found
        motion = self.slave.gather(ahead[0])[self.slave.owned], self.master.gather(ahead[1])
        change, facet = self._crossings(found, master, *motion)
        start, _ = facets.closest_point(x[found.node[change]], corners[facet])
        other = self._measure(x, master, found.node[change], facet, start, reach)
        stay = ~np.isin(found.node, other.node)
        order = np.argsort(np.concatenate([found.node[stay], other.node]))
        return Candidates(
            *(np.concatenate([a[stay], b])[order] for a, b in zip(found, other, strict=True))
        )

    def _measure(
        self,
        x: FloatArray,
        master: FloatArray,
        node: IntArray,
        facet: IntArray,
        start: FloatArray,
        reach: float,
    ) -> Candidates:
        """Those of the pairs (node, facet) that may touch; projected from `start`."""
        pair = self.master.control_points(master, facet)
        xi, converged = facets.project(x[node], pair, start)
        foot, _, normal = facets.frame(pair, xi)
        gap = np.einsum("ni,ni->n", normal, x[node] - foot)
        length = facets.size(pair)
        legal = converged & self._over_facet(facet, xi, reach / length) & self._movable(node, facet)
        legal &= (gap > -_MARGIN * length) & (gap < reach + _MARGIN * length)
        return Candidates(
            node[legal], facet[legal], xi[legal], normal[legal], gap[legal], length[legal]
        )

    def _crossings(
        self, c: Candidates, master: FloatArray, slave_motion: FloatArray, master_motion: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Candidates that slide over an edge before the middle of the step, and their next facet.

        A facet that holds the longer part of the path makes g_0 as often positive as negative, so
        that what changes of facet cost and bring cancels in the long run.
        """
        nc = self.master.facets.shape[1]
        pair = self.master.control_points(master, c.facet)
        shape, _, _ = facets.shape(c.xi, pair.shape[1])
        _, tangents, _ = facets.frame(pair, c.xi)
        motion = slave_motion[c.node]
        carried = self.master.control_points(master_motion, c.facet)
        motion = motion - np.einsum("ni,nij->nj", shape, carried)
        metric = np.einsum("naj,nbj->nab", tangents, tangents)
        slide = _solve(metric, np.einsum("naj,nj->na", tangents, motion))
        before, after = (facets.edge_excess(xi, nc) for xi in (c.xi, c.xi + slide))
        edge = after.argmax(axis=1)
        pairs = np.arange(len(edge))
        joined = self._joined[c.facet, edge]
        over = (before.max(axis=1) <= 0.0) & (after[pairs, edge] > search.PREFERENCE)
        change = np.flatnonzero(over & (joined >= 0))
        return change, joined[change] // nc

    def _over_facet(self, facet: IntArray, xi: FloatArray, reach: FloatArray) -> BoolArray:
        """Whether pairs within `reach` (in facet sizes) may touch there; a facet is 2 xi wide."""
        beyond = facets.edge_excess(xi, self.master.facets.shape[1])
        wedge = _WEDGE + 2.0 * (reach + _MARGIN)
        limit = np.where(self._free_edges[facet], _OVERHANG, wedge[:, None])
        inside: BoolArray = (beyond <= limit).all(axis=1)
        return inside

    def _movable(self, node: IntArray, facet: IntArray) -> BoolArray:
        """Whether any coordinate of a pair is free; without one there is nothing to solve for."""
        slave = self.slave.fixed[self.slave.owned[node]].all(axis=1)
        master = self.master.fixed[self.master.patches[facet]].all(axis=(1, 2))
        return ~(slave & master)


def _solve(a: FloatArray, b: FloatArray) -> FloatArray:
    """Solve a (n, k, k) y = b (n, k)."""
    return nts.solve(a, b[:, :, None])[:, :, 0]


class Contribution(NamedTuple):
    """Step equations of the pairs at an iterate, all rows [kg m] for unknowns in [m].

    Attributes:
        residual: Shape (n, r), r = 3 (nc + 1) + augmented + multipliers.
        tangent: Shape (n, r, r).
        gap: g_N at t_{n+1} [m], shape (n,).
        active: Active set of the iterate, shape (n,).
    """

    residual: FloatArray
    tangent: FloatArray
    gap: FloatArray
    active: BoolArray


@dataclass(frozen=True, eq=False)
class ContactStep:
    """The candidates of one pair of surfaces in one step, with the rule of the integrator.

    Attributes:
        pair: Its surfaces.
        candidates: This rank's slave nodes and their facets.
        rule: "direct" for the midpoint rule, else the discrete gradient.
        condense: Whether (d, f) and their multipliers are eliminated pair by pair.
        x0: Slave and corners, or control points of the patch, at t_n [m], shape (n, nc + 1, 3).
        scale: Force per motion of the slaves in the units of the step equations, shape (n,): the
            nodal mass [kg] in dynamics; scales multipliers and the active set.
        theta: Where between t_n and t_{n+1} the direct rule takes the contact force.
    """

    pair: ContactPair
    candidates: Candidates
    rule: str
    condense: bool
    x0: FloatArray
    scale: FloatArray
    theta: float

    @property
    def num_pairs(self) -> int:
        """Candidates on this rank."""
        return len(self.candidates.node)

    @property
    def num_corners(self) -> int:
        """Points that the master surface over a facet depends on: its corners, or its patch's."""
        return self.pair.master.patches.shape[1]

    @property
    def num_coordinates(self) -> int:
        """Coordinates of the slave and the corners of a pair."""
        return 3 * (self.num_corners + 1)

    @property
    def _only_normal(self) -> bool:
        return self.condense or self.rule == "direct"

    @property
    def num_augmented(self) -> int:
        """Unknowns d and f per pair."""
        return 0 if self._only_normal else nts.NUM_AUGMENTED

    @property
    def num_multipliers(self) -> int:
        """Multipliers per pair."""
        return 1 if self._only_normal else nts.NUM_CONSTRAINTS

    def dofs(self) -> tuple[IntArray, IntArray]:
        """Global coordinates of slaves (n, 3) and facets (n, 3 nc); -1 where prescribed."""
        c, slave, master = self.candidates, self.pair.slave, self.pair.master
        points, corners = slave.owned[c.node], master.patches[c.facet]
        s = np.where(slave.fixed, -1, slave.dofs)[points]
        m = np.where(master.fixed, -1, master.dofs)[corners].reshape(-1, 3 * self.num_corners)
        return s, m

    def points(self) -> tuple[IntArray, IntArray]:
        """Global coordinates as in `dofs`, prescribed ones included."""
        c, slave, master = self.candidates, self.pair.slave, self.pair.master
        corners = master.patches[c.facet]
        return slave.dofs[slave.owned[c.node]], master.dofs[corners].reshape(
            -1, 3 * self.num_corners
        )

    def reference(self) -> FloatArray:
        """Reference positions of slaves and corners [m], shape (n, nc + 1, 3)."""
        c, slave, master = self.candidates, self.pair.slave, self.pair.master
        nodes = slave.reference[slave.owned[c.node]]
        return np.concatenate([nodes[:, None], master.reference[master.patches[c.facet]]], axis=1)

    def rows(self, k: Contribution, name: str) -> FloatArray:
        """The residual's rows of "augmented" unknowns or "multipliers", shape (n, width)."""
        start = self.num_coordinates
        middle = start + self.num_augmented
        return k.residual[:, start:middle] if name == "augmented" else k.residual[:, middle:]

    def initial_guess(self, x: FloatArray) -> FloatArray:
        """Scaled d and f that fit predicted positions x (n, nc + 1, 3), shape (n, augmented)."""
        if not self.num_augmented:
            return np.empty((self.num_pairs, 0))
        return self._augmented(self._control(x))

    def _control(self, x: FloatArray) -> FloatArray:
        """Slave and control points from slave and points of the patch, both (n, nc + 1, 3)."""
        control = self.pair.master.combine(x[:, 1:], self.candidates.facet)
        return np.concatenate([x[:, :1], control], axis=1)

    def _to_points(self, part: Contribution) -> None:
        """The transpose of `_control`: forces and tangents of control points to their points."""
        weights = self.pair.master.weights
        if weights is None:
            return
        n, size = part.residual.shape
        width, middle = self.num_coordinates - 3, (self.num_corners, 3)
        rows = slice(3, self.num_coordinates)
        w = weights[self.candidates.facet].transpose(0, 2, 1)
        force = np.matmul(w, part.residual[:, rows].reshape(n, *middle))
        part.residual[:, rows] = force.reshape(n, width)
        columns = part.tangent[:, :, rows].reshape(n, size, *middle)
        part.tangent[:, :, rows] = np.matmul(w[:, None], columns).reshape(n, size, width)
        lines = part.tangent[:, rows].reshape(n, self.num_corners, 3 * size)
        part.tangent[:, rows] = np.matmul(w, lines).reshape(n, width, size)

    def _augmented(self, x: FloatArray) -> FloatArray:
        xi = self._projection(x)
        _, _, normal = facets.frame(x[:, 1:], xi)
        return np.column_stack([normal, xi]) * self.candidates.length[:, None]

    def evaluate(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> Contribution:
        """Residual and tangent of the pairs; pure.

        Args:
            x: Slave and corners at t_{n+1} [m], shape (n, nc + 1, 3).
            augmented: Facet size times (d, f) [m], shape (n, 5) or (n, 0).
            multiplier: h^2/2 lambda of the scaled constraints over `scale` [m], shape (n, 6) or
                (n, 1).
        """
        scale = self.scale[:, None]
        part = self._evaluate(self._control(x), augmented, scale * multiplier)
        self._to_points(part)
        # With mass in rows and columns the whole matrix is in kg, whatever the size of the scene.
        rows = slice(part.residual.shape[1] - self.num_multipliers, None)
        part.residual[:, rows] *= scale
        part.tangent[:, rows] *= scale[:, None]
        part.tangent[:, :, rows] *= scale[:, None]
        return part

    def _evaluate(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> Contribution:
        """As `evaluate` for multipliers in [kg m] and constraints in [m]."""
        if self.rule == "direct":
            return self._direct(x, multiplier)
        if self.condense:
            return self._condensed(x, multiplier)
        residual, tangent, gap = self._invariants(x, augmented, multiplier)
        row = residual.shape[1] - nts.NUM_CONSTRAINTS
        return self._complementarity(residual, tangent, gap, multiplier[:, 0], row)

    def _direct(self, x: FloatArray, multiplier: FloatArray) -> Contribution:
        middle, end = (self._gap(p) for p in (self.x0 + self.theta * (x - self.x0), x))
        n, size = self.num_pairs, self.num_coordinates
        gradient = middle.gradient.reshape(n, size)
        residual = np.concatenate([multiplier * gradient, end.value[:, None]], axis=1)
        tangent = np.zeros((n, size + 1, size + 1))
        tangent[:, :size, :size] = self.theta * multiplier[:, :, None] * middle.hessian
        tangent[:, :size, size] = gradient
        tangent[:, size, :size] = end.gradient.reshape(n, size)
        return self._complementarity(residual, tangent, end.value, multiplier[:, 0], size)

    def _gap(self, x: FloatArray) -> nts.Gap:
        return nts.gap(x, self._projection(x))

    def _projection(self, x: FloatArray) -> FloatArray:
        """Convective coordinates (n, 2); NaN, which no step survives, where there is none."""
        xi, converged = facets.project(x[:, 0], x[:, 1:], self.candidates.xi)
        xi[~converged] = np.nan
        return xi

    def _invariants(
        self, x: FloatArray, augmented: FloatArray, multiplier: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Scaled residual and tangent of (x, d, f, multipliers), and the gap."""
        c, n = self.candidates, self.num_pairs
        length = c.length[:, None]
        positions = (n, self.num_coordinates)
        z0 = np.concatenate([self.x0.reshape(positions), c.normal, c.xi], axis=1)
        z1 = np.concatenate([x.reshape(positions), augmented / length], axis=1)
        # One length per pair makes every unknown a length or a force, so blocks compare across
        # units and scales.
        row, one = 1.0 / length, np.ones_like(length)
        scale_z = np.concatenate([np.ones(positions), np.tile(row, nts.NUM_AUGMENTED)], axis=1)
        scale_g = np.concatenate([one, one, one, length, row, row], axis=1)
        e = nts.element(z0, z1, multiplier * scale_g, self.rule)
        size = z1.shape[1]
        total = size + nts.NUM_CONSTRAINTS
        residual = np.concatenate([e.force * scale_z, e.constraint * scale_g], axis=1)
        tangent = np.zeros((n, total, total))
        tangent[:, :size, :size] = e.stiffness * scale_z[:, :, None] * scale_z[:, None]
        mixed = scale_g[:, :, None] * scale_z[:, None]
        tangent[:, :size, size:] = (e.force_gradient * mixed).transpose(0, 2, 1)
        tangent[:, size:, :size] = e.constraint_gradient * mixed
        return residual, tangent, e.constraint[:, 0]

    def _condensed(self, x: FloatArray, multiplier: FloatArray) -> Contribution:
        """The element in (x, lambda_N): five constraints fix d and f, whose rows fix the rest.

        At the projection of t_{n+1} the augmented constraints hold, and the rows of d and f are
        linear in their multipliers; the Schur complement is then the exact tangent.
        """
        n, size = self.num_pairs, self.num_coordinates
        normal = size + nts.NUM_AUGMENTED
        augmented = self._augmented(x)
        full = np.zeros((n, nts.NUM_CONSTRAINTS))
        full[:, :1] = multiplier
        rows, columns = slice(size, normal), slice(normal + 1, None)
        residual, tangent, _ = self._invariants(x, augmented, full)
        full[:, 1:] = -_solve(tangent[:, rows, columns], residual[:, rows])
        residual, tangent, gap = self._invariants(x, augmented, full)
        outer = np.r_[:size, normal]
        inner = np.setdiff1d(np.arange(tangent.shape[1]), outer)
        left = tangent[:, outer[:, None], inner]
        inside = nts.solve(tangent[:, inner[:, None], inner], tangent[:, inner[:, None], outer])
        reduced = tangent[:, outer[:, None], outer] - np.matmul(left, inside)
        return self._complementarity(residual[:, outer], reduced, gap, multiplier[:, 0], size)

    def _complementarity(
        self,
        residual: FloatArray,
        tangent: FloatArray,
        gap: FloatArray,
        force: FloatArray,
        row: int,
    ) -> Contribution:
        """Semi-smooth active set (theory section 9): g_N = 0 where active, else lambda_N = 0."""
        gap = gap.copy()
        active = -force - self.scale * gap > 0
        off = ~active
        residual[off, row] = force[off] / self.scale[off]
        tangent[off, row] = 0.0
        tangent[off, row, row] = 1.0 / self.scale[off]
        return Contribution(residual, tangent, gap, active)
