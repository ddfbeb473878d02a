"""Shear-deformable shells: places and a director at the nodes of quadrilaterals (section 15)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from dolfinx.mesh import Mesh

from dolfinx_nts.bodies.conditions import Dirichlet
from dolfinx_nts.bodies.loads import Pressure
from dolfinx_nts.bodies.slender.director_body import DirectorBody
from dolfinx_nts.bodies.slender.director_loads import Load
from dolfinx_nts.bodies.slender.director_mesh import SIDES, WholeSkin, of_shell
from dolfinx_nts.bodies.slender.midsurface import check_midsurface, midsurface_of
from dolfinx_nts.bodies.slender.node_conditions import Clamp
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import shell as kernel
from dolfinx_nts.kernels.quadratic import Elements
from dolfinx_nts.types import FloatArray, IntArray, Marker, Places, Settings, Values
from dolfinx_nts.validation import (
    is_finite,
    known_options,
    require_bool,
    require_name,
    require_one_of,
    require_positive,
    vector,
)

Vector = Sequence[float] | FloatArray

#: Sine of the angle between a direction and a director within which they are parallel.
_PARALLEL = 1e-6


@known_options
class Shell(DirectorBody):
    """A shell on a mesh of its middle surface, flat or curved, with stretch, bending and shear.

    A node has six coordinates: its place phi and D = t/2 d, d of unit length by a constraint, along
    the normal in the reference, which is free of stress. A material point is phi + z d. The energy
    is quadratic in strains that are quadratic in the coordinates, transverse shear is the assumed
    one of MITC4 (theory section 15), so that thin shells do not lock in it and the energy-momentum
    scheme keeps the energy to rounding. The top is where cells are seen counter-clockwise, and
    where their mesh does not agree in that, the one with the first nodes of the input.

    Limits: linear elastic, isotropic, of one thickness; no T-junctions, no cells that share a node
    alone, and no folds of more than
    60 degrees between neighbouring cells; a director does not feel what turns about it; `Dirichlet`
    prescribes places alone, which is a hinge; joints and springs hold nodes.

    Args:
        mesh: Quadrilaterals of degree 1 whose points have three coordinates.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio [-].
        thickness: [m].
        density: [kg/m^3].
        velocity: At the start [m/s], a vector, or a function x (3, n) -> (3, n).
        angular_velocity: At the start, about the centre of mass [rad/s].
        bcs: `Clamp` and `Dirichlet` conditions, whose functions `where` select nodes.
        forces: `Pressure`, `PointForce`, `PointMoment`, `LineForce` and `LineMoment` loads.
        name: Name in messages and files.

    Attributes:
        u: Displacement of the middle surface [m], dolfinx Function of the last accepted state.
        v: Velocity of the middle surface [m/s], dolfinx Function.
        space: Their function space.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or the mesh is not one of quadrilaterals in space,
            or has a flat cell, a T-junction, a fold or one side alone.
    """

    kind = "shell"

    def __init__(
        self,
        mesh: Mesh,
        *,
        young: float,
        poisson: float,
        thickness: float,
        density: float,
        velocity: Values = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        bcs: Sequence[Clamp | Dirichlet] = (),
        forces: Sequence[Load | Pressure] = (),
        name: str = "shell",
    ) -> None:
        require_name("name", name)
        units = {"young": "Pa", "thickness": "m", "density": "kg/m^3"}
        for what, value in (("young", young), ("thickness", thickness), ("density", density)):
            require_positive(what, value, units[what])
        if not (is_finite(poisson) and -1.0 < poisson <= 0.5):
            raise ValueError(f"poisson={poisson!r}: must lie above -1 and not above 0.5")
        check_midsurface(mesh, name)
        spin = vector("angular_velocity", angular_velocity, "rad/s")
        self.young, self.poisson, self.thickness = float(young), float(poisson), float(thickness)
        self.density = float(density)
        self._set_up_mesh(mesh, name)
        surface = midsurface_of(self.space, name)
        # Of the place, and of D: rho t^3/12 on d = D / (t/2).
        masses = density * thickness * np.array([1.0, 1.0 / 3.0])
        self._set_up(surface, 0.5 * thickness, masses, bcs, forces, velocity, spin)

    def _elements_of(self, y: FloatArray) -> tuple[Elements, FloatArray]:
        """This rank's elements from their reference, see `DirectorBody`."""
        stiffness = kernel.stiffness(self.young, self.poisson, self.thickness)
        return kernel.shells(y, self.length, stiffness)

    @property
    def _neighbours(self) -> IntArray:
        return np.array([[0, 1], [1, 2], [2, 3], [3, 0]])

    def _finer(self, times: float) -> str:
        """Which elements are needed, see `DirectorBody`."""
        return (
            f"about {times:.2g} times as many elements are needed there in that direction for 3 %"
        )

    def _felt(self, turn: float) -> tuple[float, float]:
        """Turn that strains feel, and its slope, see `DirectorBody`."""
        return 2.0 * float(np.sin(0.5 * turn)), float(np.cos(0.5 * turn))

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        own = {name: getattr(self, name) for name in ("young", "poisson", "thickness", "density")}
        return {**own, **super().settings}

    def midsurface(self) -> tuple[FloatArray, FloatArray]:
        """Nodes in the order of the mesh's input, the same on all ranks. Collective.

        Returns:
            In the reference X and now x [m], shape (n, 3) each.
        """
        return self._in_order()

    def _make_skin(self) -> WholeSkin:
        """Its whole skin, see `DirectorBody`."""
        return of_shell(self._director_mesh)

    def surface(
        self, marker: Marker = None, *, side: str = "top", smoothing: bool = False
    ) -> Surface:
        """A part of the skin for contact, half a thickness from the middle surface. Collective.

        Args:
            marker: Function x (3, n) -> bool (n,) that holds at all nodes of a cell, or of an edge,
                of the middle surface; None: everywhere.
            side: "top", "bottom" or "edge".
            smoothing: Whether slaves touch a smooth surface when this one is the master, as of
                `Continuum.surface`.

        Raises:
            TypeError: marker is no function, or smoothing no bool.
            ValueError: side is unknown, or the marker selects nothing.
        """
        require_bool("smoothing", smoothing)
        require_one_of("side", side, SIDES)
        x = self._director_mesh.x[self._skin.whole_skin.node]
        chosen = self._skin.marked(marker, self._skin.whole_skin.part == SIDES.index(side), x)
        return self._skin.surface(chosen, smoothing)

    def force_and_moment(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Forces [N/m] and moments [N] of a length, in axes of the reference, (n, 3, 3) each.

        Forces are those of the membrane and, in the rows and columns of the normal, transverse
        shear; moments bend and twist.
        """
        middle = np.zeros((1, 2))
        e = kernel.strains(y, self.elements.rest, self.length, middle)[:, 0]
        axes = kernel.axes(self.elements.rest[:, ::2], middle)[0][:, 0]
        c = kernel.stiffness(self.young, self.poisson, self.thickness)
        local = np.zeros((2, len(e), 3, 3))
        for k, stress in enumerate((e[:, :3] @ c.membrane, e[:, 3:6] @ c.bending)):
            local[k, :, [0, 1, 0, 1], [0, 1, 1, 0]] = stress[:, [0, 1, 2, 2]].T
        local[0, :, :2, 2] = local[0, :, 2, :2] = c.shear * e[:, 6:]
        force, moment = np.einsum("npi,knpq,nqj->knij", axes, local, axes)
        return force, moment

    def directions_at(self, direction: FloatArray, x: Places) -> Points:
        """As of `Body`, at a node; ValueError unless along its director. Collective."""
        nodes = self.points(x).nodes[:, 0] // 2
        director = self._director_mesh.directors[nodes[0], 0]
        along = float(director @ direction)
        if np.linalg.norm(direction - along * director) > _PARALLEL * np.linalg.norm(direction):
            raise ValueError(
                f"direction {np.asarray(direction).tolist()} at a node of shell {self.name!r}: "
                f"only its director {director.tolist()} turns with it; hold it by Spherical joints "
                "at several nodes"
            )
        return self.points_of(nodes, np.array([[0.0, along / self.length]]))
