"""The skin of a beam or shell: which of its facets are a surface, and where they are."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from dolfinx_nts.bodies.slender.director_mesh import WholeSkin
from dolfinx_nts.contact.skins import Skin, in_order
from dolfinx_nts.contact.surfaces import Surface, Touching
from dolfinx_nts.kernels.vectors import range_of
from dolfinx_nts.types import BoolArray, FloatArray, Marker
from dolfinx_nts.validation import at_points


class DirectorSkin:
    """Surfaces of a body whose nodes have directors.

    Args:
        body: The body.
        whole_skin: All of it.
        here: Global numbers of the nodes of this rank.
    """

    def __init__(self, body: Any, whole_skin: WholeSkin, here: slice) -> None:
        self._body, self.whole_skin, self._here = body, whole_skin, here
        self._touching = Touching(whole_skin.node)

    def surface(self, chosen: BoolArray, smoothing: bool = False) -> Surface:
        """Some of the facets of the skin, chosen by a mask. Collective."""
        whole, here = self.whole_skin, self._here
        used, inverse = np.unique(whole.facets[chosen], return_inverse=True)
        facets, original = inverse.reshape(-1, 4), whole.original[used]
        roll, order = in_order(original[facets])
        facets = np.take_along_axis(facets, roll, axis=1)[order]
        node, columns = whole.node[used], np.flatnonzero(whole.weights.any(axis=0))
        points = self._body.points_of(node, whole.weights[used]).columns(columns)
        rows = node[(node >= here.start) & (node < here.stop)] - here.start
        skin = Skin(used, facets, original, points.combine(points.reference), rows, points)
        return Surface(self._body, skin, smoothing, self._touching)

    def marked(self, marker: Marker, facets: BoolArray, x: FloatArray) -> BoolArray:
        """Which of some facets a user's marker selects, shape (m,). Collective.

        Args:
            marker: Function x (3, n) -> bool (n,), or None.
            facets: Mask of the facets to choose from.
            x: What it is asked for, of each point of the skin [m], shape (p, 3).

        Raises:
            TypeError: The marker is no function.
            ValueError: It selects nothing.
        """
        if marker is None:
            return facets
        what = f"marker of a surface of {self._body.name!r}"
        if not callable(marker):
            raise TypeError(f"{what}={marker!r}: pass a function of x with shape (3, n)")
        chosen = at_points(self._body.comm, what, marker, x.T, (), "b")
        found: BoolArray = facets & chosen[self.whole_skin.facets].all(axis=1)
        if not found.any():
            raise ValueError(f"{what}={marker!r}: selects no facet; check its tolerance")
        return found

    @cached_property
    def whole(self) -> Surface:
        """All of it. Collective."""
        return self.surface(np.ones(len(self.whole_skin.facets), dtype=bool))

    def range_of(self, motion: FloatArray) -> FloatArray:
        """Bounds on the motion of its points on this rank, as of `Body.motion_range` [m].

        Args:
            motion: Of the nodal vectors [m], shape (n, vectors, 3).
        """
        reach = np.abs(self.whole_skin.weights).max(axis=0)
        return range_of(motion[:, 0], np.einsum("k,nki->ni", reach[1:], np.abs(motion[:, 1:])))
