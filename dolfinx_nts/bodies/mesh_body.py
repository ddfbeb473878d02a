"""Bodies whose surfaces are parts of the boundary of their mesh: flexible solids and rigid ones."""

from __future__ import annotations

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.facet_choice import choose_facets
from dolfinx_nts.contact.skins import skin_of_mesh
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.types import Marker, Vector
from dolfinx_nts.validation import require_bool, require_one_of


class MeshBody(Body):
    """A body that has surfaces by markers of facets of its mesh."""

    def _check_surface(self, mass: str) -> None:
        """Raise ValueError where the body has no surface of such a mass."""

    def _make_massless(self, surface: Surface) -> None:
        """Take the mass of a surface's nodes, and give it to others. Collective."""
        raise NotImplementedError

    def surface(
        self,
        marker: Marker,
        tag: int | None = None,
        *,
        normal: Vector | None = None,
        angle: float | None = None,
        smoothing: bool = False,
        mass: str = "consistent",
    ) -> Surface:
        """A part of the boundary for contact.

        Of a body of degree 2 the faces are curved as its cells are, and all nodes touch (theory
        19.6).

        With smoothing, of degree 1, a slave touches a smooth surface through the nodes instead of
        the flat or bilinear facets of a master. It is linear in the nodes, so momentum and energy
        are kept as without. Over quadrilaterals lie bicubic patches of Overhauser's cubics (Catmull
        and Rom 1974), over each triangle three quartic ones (Clough and Tocher 1965; Shirman and
        Sequin 1987) whose tangent planes fit the rings of its nodes, of any number of neighbours.
        The normal no longer jumps from facet to facet, and the energy lost or gained by changes of
        facet (`contact_defect`) falls: on a cylinder more than 1e4 times on even quadrilaterals, 20
        to 100 times where they differ by up to a half in size, 4e3 times and more on triangles,
        even or not. For smoothing in contact see Wriggers, Krstulovic-Opara and Korelc (2001) and
        Puso and Laursen (2002). Limits:

        - It is not smooth at edges whose facets meet at more than 60 degrees, at nodes where other
          than four quadrilaterals meet, and at nodes whose triangles see no common plane, such as
          corners where three sharp edges meet on a flat side. A warning says how many facets.
        - It bulges beyond the facets by what they cut off the curve, an eighth of the angle between
          neighbours times the size of a facet: gaps are measured from there.
        - Beyond its facet a patch goes on as a polynomial, which is good for half a facet; let no
          slave slide over more than a third of a facet in a step.
        - An element of a pair takes some ten times as long, and a triangle some 8 kB on each rank.
          As a slave, a surface is not changed.

        With mass="redistributed" the nodes of a slave surface have no mass (theory section 16;
        Khenous, Laborde and Renard 2008): other nodes get it, and the body keeps its mass, centre
        of mass and inertia. An impact then stops no mass at once, so its contact forces do not
        alternate from step to step. The laws of contact and friction hold for the forces at
        t_{n+1}, and those of the step are the mean of both ends, so that momenta and the ledger
        are as exact as without (`massless_defect` in the balance). Only the slave of a contact may
        have it, of a Continuum with some four cells behind the surface, with `EnergyMomentum()` or
        `Midpoint()` and without restored impacts. `equilibrium` refuses it: a run begins from that
        of a body of the same mesh and name without it. Gravity then moves with the mass, so that
        what rests under its weight starts as far off balance, and the run warns of it.

        Args:
            marker: Callable x (3, n) -> bool (n,) that holds at all corners of a facet, or facet
                meshtags.
            tag: Value in the meshtags.
            normal: Choose those of the marker's facets that face this way, an outward normal of the
                reference of any length, shape (3,); `angle` says how nearly.
            angle: With `normal`, the largest angle between both. Without it, the feature angle: go
                on from the marker's facets, also to others, over all edges at which the boundary
                turns by less, so that one facet of a face without sharp edges, such as a cylinder's
                mantle, is enough to have it all. Above 0, up to 180 [degrees].
            smoothing: Whether slaves touch a smooth surface when this one is the master.
            mass: "consistent" or "redistributed".

        Raises:
            TypeError: smoothing is no bool.
            ValueError: No mesh, degree above 2, no facet, or interior facets, or none that faces
                `normal`; normal or angle is none, or normal is given alone; smoothing of degree 2;
                mass is unknown, or "redistributed" of a rigid body or of degree 2; too little of
                the body is left beside the surface to take its mass, or the body has moved already.
        """
        require_bool("smoothing", smoothing)
        require_one_of("mass", mass, ("consistent", "redistributed"))
        self._check_surface(mass)
        if smoothing and (self.degree or 1) > 1:
            raise ValueError(
                f"smoothing={smoothing!r} of a surface of {self.name!r}: its faces are curved "
                f"themselves, of degree {self.degree}; leave smoothing out"
            )
        what = f"marker of a surface of {self.name!r}"
        found = choose_facets(self.mesh, marker, tag, normal, angle, what)
        surface = Surface(self, skin_of_mesh(self, found), smoothing)
        if mass == "redistributed":
            self._make_massless(surface)
        return surface
