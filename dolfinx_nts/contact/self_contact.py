"""Contact of a surface with itself: coils, folds, slots, a strip that buckles onto itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dolfinx_nts.contact import passages, search
from dolfinx_nts.contact.along_surface import Neighbourhoods
from dolfinx_nts.contact.candidates import Candidates, Found, Motion
from dolfinx_nts.contact.facet_pair import FacetPair
from dolfinx_nts.contact.facing import opposite
from dolfinx_nts.contact.pair import INITIAL_PENETRATION
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels import facets
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import known_options

#: Of two sides one is finer if it has so many times the nodes of the other.
_FINER = 1.1
#: Mean distances of two parts from the middle are alike up to this part of the surface's extent.
_ALIKE = 1e-9
#: A node of the master's part is kept out of a facet of which less than this part is carried by
#: slaves, and is so until they carry that part.
_ENTERS, _STAYS = 0.9, 0.95


@known_options
class SelfContact(FacetPair):
    """Nodes of a surface must not penetrate its own facets.

    A node may touch facets that face it, but for those beside it on the surface: such as share a
    corner with one of its own facets, and others as long as the way along the surface is no longer
    than three times that through space. Sides of a fold so touch once it has closed to some 37
    degrees, and a fold stays open at its bottom by some facets' size.

    Where two parts of the surface face each other, nodes of one of them are kept out of facets of
    the other, not the other way round as well, or flat parts would be held twice: those of the
    finer part, of equal ones of that nearer to the middle of the surface in the reference, or with
    the lowest input number, as long as they touch; at a rim also nodes of the other part that lie
    between nodes that nothing else holds. So what `ContactPair` says of slave and master holds, and
    so do its energy, momenta and ledger. Forces of the contact are those on these nodes.

    A part may not be thinner than a hundredth of its facets, and parts that start inside each other
    by more than that are not seen.

    Args:
        surface: Of a body that deforms, e.g. `body.surface(lambda x: x[0] < 1)`.
        friction: As of `ContactPair`.
        name: As of `ContactPair`.

    Raises:
        TypeError: `surface` is no Surface.
        ValueError: Its body is rigid, or friction is negative or no number.
    """

    def __init__(
        self, surface: Surface, *, friction: float = 0.0, name: str | None = None
    ) -> None:
        if not isinstance(surface, Surface):
            raise TypeError(f"surface={surface!r}: pass a Surface, e.g. body.surface(marker)")
        super().__init__(surface, surface, friction=friction, edges=False, name=name)

    def _check_surfaces(self) -> None:
        body = self.slave.body
        if body.rigid:
            raise ValueError(
                f"surface: {body.name!r} is rigid and cannot touch itself; drop the contact"
            )
        self._own = Neighbourhoods(self.slave.facets, self.slave.reference)

    def _closest(
        self, slaves: FloatArray, corners: FloatArray, reach: float, current: IntArray
    ) -> search.Closest:
        """The closest facets that face nodes and are not beside them."""
        share, at = self.slave.share, self.slave.facets
        nodal, normal = self._normals(slaves)
        middle, depth = corners.mean(axis=1), INITIAL_PENETRATION * facets.size(corners)

        def faces(point: IntArray, facet: IntArray) -> BoolArray:
            facing = opposite(nodal[share[point]], normal[facet])
            some = np.flatnonzero(facing)
            point, facet = point[some], facet[some]
            rise = np.einsum("ni,ni->n", slaves[share[point]] - middle[facet], normal[facet])
            # What is behind is seen through the body, if it is no neighbour of what it touches.
            now = current[point]
            joined = (at[facet][:, :, None] == at[now][:, None]).any(axis=(1, 2)) & (now >= 0)
            facing[some] = (rise > -depth[facet]) | joined
            return facing

        def apart(point: IntArray, facet: IntArray, distance: FloatArray) -> BoolArray:
            return ~self._own.beside(share[point], facet, distance)

        return search.closest_facets(
            slaves[share], corners, reach=reach, current=current,
            admits=search.Admits(faces, apart),
        )  # fmt: skip

    def stops(self, node: IntArray, master: FloatArray) -> passages.Stops:
        """Those that face the node and share no corner with facets of it."""
        number, (nodal, normal) = self.slave.share[node], self._normals(master)

        def stops(point: IntArray, facet: IntArray) -> BoolArray:
            beside = self._own.beside(number[point], facet, np.zeros(len(point)))
            return ~beside & opposite(nodal[number[point]], normal[facet])

        return stops

    def sunk(
        self, x: FloatArray, least: float
    ) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Nodes that may lie inside another part of the body.

        They are behind facets that face them, and were not, or not as deep, in the reference, as
        the other side of a plate is.

        Args:
            x: Positions of all points [m].
            least: Depth of interest in facet sizes.

        Returns:
            Positions of nodes in the surface, the facets, and the depths [m], shape (n,) each, and
            the nodes' inward unit normals, shape (n, 3).
        """
        at, reference = self.slave.facets, self.slave.reference
        corners, (nodal, normal) = x[at], self._normals(x)
        middle, size = corners.mean(axis=1), facets.size(corners)
        was, before = reference[at].mean(axis=1), self._normals(reference)[1]

        def faces(point: IntArray, facet: IntArray) -> BoolArray:
            facing = opposite(nodal[point], normal[facet])
            some = np.flatnonzero(facing)
            point, facet = point[some], facet[some]
            rise = np.einsum("ni,ni->n", x[point] - middle[facet], normal[facet])
            rose = np.einsum("ni,ni->n", reference[point] - was[facet], before[facet])
            facing[some] = (rise < -least * size[facet]) & (rose > 0.5 * rise)
            return facing

        def apart(point: IntArray, facet: IntArray, distance: FloatArray) -> BoolArray:
            return ~self._own.beside(point, facet, np.zeros(len(point)))

        reach = float(size.max(initial=0.0))
        found = search.closest_facets(x, corners, reach=reach, admits=search.Admits(faces, apart))
        node = np.flatnonzero(found.facet >= 0)
        return node, found.facet[node], found.distance[node], -nodal[node]

    def _normals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outward unit normals at points (p, 3), means of their facets', and of facets (m, 3)."""
        at = self.slave.facets
        arm = x[at] - x[at].mean(axis=1, keepdims=True)
        normal = cross(arm, np.roll(arm, -1, axis=1)).sum(axis=1)
        nodal = np.zeros_like(x)
        np.add.at(nodal, at, normal[:, None])
        for vectors in (nodal, normal):
            vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        return nodal, normal

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """Search for this rank's candidates, of one of two parts that face each other."""
        found = yield from super().find(positions, current, path, motion, followed)
        c = found.candidates
        if not (yield len(c.node) > 0):
            return found
        return found._replace(candidates=c.select(self._one_sided(c, current, positions[0])))

    def measure(
        self, x: FloatArray, master: FloatArray, node: IntArray, facet: IntArray, start: FloatArray,
        reach: float | None,
    ) -> tuple[Candidates, IntArray]:  # fmt: skip
        """As of `FacetPair`, but nothing is held in the plane of a facet beyond which it is."""
        found, beyond = super().measure(x, master, node, facet, start, reach)
        number, nc = self.slave.share[found.node], self.slave.facets.shape[1]
        zero = np.zeros(len(number))
        own = self._own.beside(number, found.facet, zero)
        excess = facets.edge_excess(found.xi, nc)
        for edge in range(nc):
            other = self.convex.beside[found.facet, edge] // nc
            out = (excess[:, edge] > search.PREFERENCE) & (other >= 0)
            own |= out & self._own.beside(number, np.maximum(other, 0), zero)
        return found.select(~own), beyond

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> Asking[IntArray | None]:
        """Do as `ContactPair`; what is behind a facet whose corners are held is the other part."""
        hit = yield from super().missed(positions, motions, path, reach, held, aimed)
        if hit is not None:
            hit[(hit >= 0) & (held < 0) & self._carries(held)[hit]] = -1
        return hit

    def _carries(self, at: IntArray) -> BoolArray:
        """Which facets have corners that are at other facets, shape (m,). Collective.

        Args:
            at: Facet of each of the rank's nodes, or -1, shape (share,).
        """
        return (self.slave.at_all(at) >= 0)[self.slave.facets].any(axis=1)

    def _one_sided(self, c: Candidates, current: IntArray, x: FloatArray) -> BoolArray:
        """Which candidates are slaves where two parts face each other, shape (n,). Collective.

        Each is joined with the candidates among the corners of its facet whose facets face that:
        what is joined are the nodes of two parts, in turn of one and of the other.

        Args:
            c: All that are within reach, of this rank.
            current: As of `find`.
            x: Positions of all points [m].
        """
        surface, normal = self.slave, self._normals(x)[1]
        at = surface.facets
        mine = np.full(len(surface.share), -1)
        mine[c.node] = c.facet
        facet, was = surface.at_all(np.column_stack([mine, current])).T
        one, corner = np.nonzero(facet[at[facet]] >= 0)
        other = at[facet[one], corner]
        joined = (facet[one] >= 0) & opposite(normal[facet[one]], normal[facet[other]])
        near = facet >= 0
        off = np.linalg.norm(surface.reference - surface.reference.mean(axis=0), axis=1)
        slave = near & _one_of_two(one[joined], other[joined], was >= 0, off, surface.original)
        # Over the rim of the other part nodes of the slave end, and what holds them there is this.
        foot, _, _ = facets.shape(c.xi, at.shape[1])
        corners = at[c.facet]
        held = facet[corners]
        faces = opposite(
            np.repeat(normal[c.facet], at.shape[1], axis=0), normal[held.ravel()]
        ).reshape(held.shape)
        carried = (foot * (slave[corners] & faces)).sum(axis=1)
        rim = carried < np.where(current[c.node] >= 0, _STAYS, _ENTERS)
        return slave[surface.share[c.node]] | rim


def _one_of_two(
    one: IntArray, two: IntArray, was: BoolArray, off: FloatArray, number: IntArray
) -> BoolArray:
    """Which nodes are the slaves of joined ones, shape (n,).

    Args:
        one: Nodes, shape (k,).
        two: Nodes of the other part that they are joined with, shape (k,).
        was: Which nodes were slaves in the last step, shape (n,).
        off: Distances from the middle in the reference, on which no frame has a say [m], (n,).
        number: Numbers of nodes, the same on any ranks, shape (n,).
    """
    n = len(number)
    # Each node twice, as one of a part and of the other: what is joined changes the part.
    rows, columns = np.concatenate([one, one + n]), np.concatenate([two + n, two])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * n, 2 * n))
    size, label = connected_components(graph, directed=False)
    mine, theirs = label[:n], label[n:]
    count, had, far = (
        np.bincount(mine, w, size) for w in (np.ones(n), was.astype(float), off)
    )
    far = far / np.maximum(count, 1.0)
    first = np.full(size, np.iinfo(np.int64).max)
    np.minimum.at(first, mine, number)
    finer = np.where(count[mine] > _FINER * count[theirs], 1, 0)
    finer -= np.where(count[theirs] > _FINER * count[mine], 1, 0)
    before = np.sign(had[mine] - had[theirs]).astype(int)
    apart = far[theirs] - far[mine]
    inner = np.where(np.abs(apart) > _ALIKE * off.max(initial=0.0), np.sign(apart), 0).astype(int)
    rank: Any = np.where(before != 0, before, np.where(finer != 0, finer, inner))
    slave: BoolArray = np.where(rank != 0, rank > 0, first[mine] < first[theirs])
    # What is joined in an odd circle has no two parts: the lower number is the slave.
    odd = np.flatnonzero(mine == theirs)
    if odd.size:
        slave[odd] = True
        lower = np.where(number[one] < number[two], two, one)
        slave[np.intersect1d(lower, odd)] = False
    return slave
