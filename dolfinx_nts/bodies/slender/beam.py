"""Geometrically exact beams: places and three directors at the nodes of intervals (section 15)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from dolfinx.mesh import Mesh

from dolfinx_nts.bodies.conditions import Dirichlet
from dolfinx_nts.bodies.slender.axis import axis_of, check_line
from dolfinx_nts.bodies.slender.director_body import DirectorBody
from dolfinx_nts.bodies.slender.director_loads import Load
from dolfinx_nts.bodies.slender.director_mesh import WholeSkin, of_beam
from dolfinx_nts.bodies.slender.node_conditions import Clamp
from dolfinx_nts.bodies.slender.section import Section
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import beam as kernel
from dolfinx_nts.kernels.quadratic import Elements
from dolfinx_nts.types import FloatArray, IntArray, Marker, Places, Settings, Values
from dolfinx_nts.validation import known_options, require_bool, require_name, vector

Vector = Sequence[float] | FloatArray


@known_options
class Beam(DirectorBody):
    """A beam on a mesh of its axis, straight or curved, with shear, stretch, bending and twist.

    A node has twelve coordinates: its place phi and D_i = l d_i, l the section's radius of gyration
    and d_i orthonormal by constraints, d_3 along the axis in the reference, which is free of
    stress. A material point is phi + x_1 d_1 + x_2 d_2. The energy is quadratic in strains that are
    quadratic in the coordinates (theory section 15), so that the energy-momentum scheme keeps it to
    rounding.

    Limits: each mesh is one line or ring, or several, without branches, and without corners of more
    than 60 degrees (`Fixed` joins beams there); `Dirichlet` prescribes places alone; joints
    and springs hold nodes.

    An element has two nodes, or with degree 2 three, with which it bends as four to eight of two
    nodes do where turns are large.

    Args:
        mesh: Intervals of degree 1 or 2 whose points have three coordinates.
        section: Stiffness and mass of the cross-section.
        direction: d_1 before it is set at right angles to the axis: a vector, or a function
            x (3, n) -> (3, n); None: of the axes y, z, x the one that is farthest from the beam's.
        velocity: At the start [m/s], a vector, or a function x (3, n) -> (3, n).
        angular_velocity: At the start, about the centre of mass [rad/s].
        bcs: `Clamp` and `Dirichlet` conditions, whose functions `where` select nodes.
        forces: `PointForce`, `PointMoment`, `LineForce` and `LineMoment` loads.
        degree: 1 or 2; None: that of the mesh. With 2 on a mesh of degree 1 middle nodes are added
            on straight lines; an axis that is curved takes a mesh of degree 2.
        name: Name in messages and files.

    Attributes:
        u: Displacement of the axis [m], dolfinx Function of the last accepted state.
        v: Velocity of the axis [m/s], dolfinx Function.
        space: Their function space.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or the mesh is not one of intervals in space, or
            has a cell without length, a branch or a corner.
    """

    kind, bound = "beam", True

    def __init__(
        self,
        mesh: Mesh,
        section: Section,
        *,
        direction: Any = None,
        velocity: Values = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        bcs: Sequence[Clamp | Dirichlet] = (),
        forces: Sequence[Load] = (),
        degree: int | None = None,
        name: str = "beam",
    ) -> None:
        require_name("name", name)
        if not isinstance(section, Section):
            raise TypeError(f"section={section!r}: pass Section(EA=..., GA=(.., ..), ...)")
        degree = check_line(mesh, degree, name)
        spin = vector("angular_velocity", angular_velocity, "rad/s")
        self.section = section
        self._set_up_mesh(mesh, name, degree)
        axis = axis_of(self.space, direction, name)
        self._set_up(axis, section.radius, section.masses, bcs, forces, velocity, spin)

    def _elements_of(self, y: FloatArray) -> tuple[Elements, FloatArray]:
        """This rank's elements from their reference, see `DirectorBody`."""
        return kernel.beams(y, self.length, self.section.stiffness)

    @property
    def _neighbours(self) -> IntArray:
        first = np.arange(self._cells.shape[1] - 1)
        return np.stack([first, first + 1], axis=1)

    def _finer(self, times: float) -> str:
        """Which elements are needed, see `DirectorBody`."""
        here = len(self._director_mesh.cells)
        needed = int(np.ceil(times * here * (1.0 - 1e-9)))
        or_less = f", or {-(-needed // 2)} with degree=2" if self.degree == 1 else ""
        return f"about {needed} elements are needed for 3 %{or_less}, where it has {here}"

    def _felt(self, turn: float) -> tuple[float, float]:
        """Turn that strains feel, and its slope, see `DirectorBody`."""
        sine, cosine = float(np.sin(turn)), float(np.cos(turn))
        if self.degree == 1:
            return sine, cosine
        # At both points, a third of the way squared from the middle node.
        return sine * (4.0 - cosine) / 3.0, (4.0 * cosine - 2.0 * cosine**2 + 1.0) / 3.0

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        return {"section": self.section, **super().settings}

    def centreline(self) -> tuple[FloatArray, FloatArray]:
        """Nodes of the axis as they follow each other, the same on all ranks. Collective.

        Returns:
            In the reference X and now x [m], shape (n, 3) each.
        """
        return self._in_order()

    def _make_skin(self) -> WholeSkin:
        """Its whole skin, see `DirectorBody`; without an outline none but the axis."""
        outline = np.array(self.section.outline, dtype=np.float64).reshape(-1, 2)
        return of_beam(self._director_mesh, outline / self.length)

    def surface(self, marker: Marker = None, *, smoothing: bool = False) -> Surface:
        """A part of the skin for contact: the section's outline along the axis, and its ends.

        Collective.

        Args:
            marker: Function x (3, n) -> bool (n,) that holds at all corners of a facet of the skin;
                None: all of it.
            smoothing: Whether slaves touch a smooth surface when this one is the master, as of
                `Continuum.surface`.

        Raises:
            TypeError: marker is no function, or smoothing no bool.
            ValueError: The section has no outline, or the marker selects nothing.
        """
        require_bool("smoothing", smoothing)
        if not len(self.section.outline):
            raise ValueError(
                f"section of {self.name!r}: has no outline, so no surface; pass Section(..., "
                "outline=[(x_1, x_2), ...]), or take one of a shape, Rectangle(b, h).section(...)"
            )
        skin = self._skin.whole_skin
        x = np.einsum("pk,pki->pi", skin.weights, self._vectors_at(skin.node))
        every = np.ones(len(skin.facets), dtype=bool)
        return self._skin.surface(self._skin.marked(marker, every, x), smoothing)

    def force_and_moment(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Force [N] and moment [N m] in the sections of the cells, vectors in space, (n, 3) each.

        They act on what lies before a section from what lies behind it.
        """
        strained, rest = self.elements.strained, self.elements.rest
        stress = kernel.strains(strained, y) * self.section.stiffness
        return kernel.resultants(stress, y, rest, self.length)

    def directions_at(self, direction: FloatArray, x: Places) -> Points:
        """As of `Body`, at a node. Collective."""
        nodes = self.points(x).nodes[:, 0] // 4
        local = self._director_mesh.directors[nodes] @ direction / self.length
        return self.points_of(nodes, np.column_stack([np.zeros(len(local)), local]))
