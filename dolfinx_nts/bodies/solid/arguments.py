"""Checks of what a Continuum is made of."""

from __future__ import annotations

from typing import Any

from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.parameters import Parameter, require_positive_parameter
from dolfinx_nts.bodies.solid.viscosity import check_viscosity
from dolfinx_nts.contact.linear_facets import HIGHEST
from dolfinx_nts.validation import require_bool, require_one_of


def check_material(material: Any, density: Parameter, viscosity: Parameter) -> None:
    """Raise unless they are of their kinds and in their ranges."""
    if not callable(material):
        raise TypeError(
            f"material={material!r}: pass a callable C -> W(C), "
            "e.g. NeoHookean(young=1e6, poisson=0.3)"
        )
    require_positive_parameter("density", density, "kg/m^3")
    check_viscosity(viscosity)


def check_cells(
    mesh: Mesh, degree: int, least: int, name: str, volume: str, bending: bool, viscous: bool
) -> None:
    """Raise unless cells, of a mesh of degree `least`, can have what they are to have."""
    if degree < least:
        raise ValueError(
            f"degree={degree!r} of {name!r}: its mesh is of degree {least}; leave degree out, "
            "or pass nts.linear(mesh)"
        )
    require_one_of("volume", volume, ("full", "projected"))
    require_bool("bending", bending)
    kind = compat.cell_name(mesh)
    plain = degree == 1 and kind == "hexahedron"
    if volume == "projected" and not plain:
        raise ValueError(
            f"volume={volume!r} of {name!r}: is for hexahedra of degree 1, not for {kind}s of "
            f"degree {degree}; use volume='full'"
        )
    if bending and not plain:
        raise ValueError(
            f"bending={bending!r} of {name!r}: is for hexahedra of degree 1, not for {kind}s of "
            f"degree {degree}; use degree=2, which bends without it"
        )
    if bending and volume == "projected":
        raise ValueError(
            f"bending={bending!r}, volume={volume!r} of {name!r}: the volume of a cell in the "
            "mean would undo its bending; pass one of the two"
        )
    if bending and viscous:
        raise ValueError(
            f"bending={bending!r} of {name!r}: is for bodies without viscosity, which would damp "
            "cells that bend by the shear of their corners; use degree=2"
        )


def check_surface(mesh: Mesh, degree: int, name: str, mass: str) -> None:
    """Raise a ValueError where a solid has no surface of such a mass.

    Args:
        mesh: Its mesh.
        degree: Of the body.
        name: Of the body.
        mass: As of `MeshBody.surface`.
    """
    if mesh.topology.dim != 3:
        raise ValueError(
            f"body {name!r}: contact surfaces are boundaries of 3D meshes, not of "
            f"{compat.cell_name(mesh)}s"
        )
    if degree > HIGHEST:
        raise ValueError(
            f"degree={degree} of body {name!r}: surfaces, of contacts and of ties, need degree 1 "
            f"or {HIGHEST}; pass degree={HIGHEST}"
        )
    if mass == "redistributed" and degree > 1:
        raise ValueError(
            f"mass={mass!r} of a surface of {name!r}: needs degree 1, as at nodes of degree "
            f"{degree} the mass of some is negative; use mass='consistent', or degree=1"
        )
