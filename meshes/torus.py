"""Two hollow tori of hexahedra, one tilted, as a Gmsh mesh: `python meshes/torus.py --help`.

The flat torus lies in the x-y plane about the origin; the tilted one is turned about the y axis
and moved. The grid of each is structured (through the wall, around the tube, along the ring), so
it is handed to Gmsh as discrete entities: no mesher can change it, and the same arguments give
the same file with every Gmsh.

Physical volumes: "flat", "tilted". Physical surfaces: "flat_outer", "flat_inner",
"tilted_outer", "tilted_inner" (inner is the inside of the tube).
"""

import argparse
from pathlib import Path

import gmsh
import numpy as np

#: Gmsh's hexahedron and quadrangle.
HEXAHEDRON, QUADRANGLE = 5, 3


def nodes_of_torus(radius, tube, wall, cells, shift=(0.0, 0.0)):
    """Nodes of a hollow torus about the z axis.

    Args:
        radius: Of the ring, to the middle of the tube [m].
        tube: Outer radius of the tube [m].
        wall: Thickness of the tube's wall [m].
        cells: Cells (through the wall, around the tube, along the ring).
        shift: Angle of the first node around the tube and along the ring [cells].

    Returns:
        Positions [m], shape (through + 1, around, along, 3).
    """
    through, around, along = cells
    r = np.linspace(tube - wall, tube, through + 1)[:, None, None]
    a = 2 * np.pi * (np.arange(around) + shift[0])[None, :, None] / around
    b = 2 * np.pi * (np.arange(along) + shift[1])[None, None, :] / along
    rho = radius + r * np.cos(a)
    return np.stack([rho * np.cos(b), rho * np.sin(b), r * np.sin(a) + 0 * b], axis=-1)


def cells_of_torus(cells):
    """Gmsh connectivity by node numbers from 0.

    Args:
        cells: Cells (through the wall, around the tube, along the ring).

    Returns:
        Hexahedra (m, 8), outer and inner quadrangles (k, 4).
    """
    through, around, along = cells
    number = np.arange((through + 1) * around * along).reshape(through + 1, around, along)
    # Corners of a quadrangle of each layer, around first: its normal points out of the tube.
    next_around, next_along = np.roll(number, -1, axis=1), np.roll(number, -1, axis=2)
    both = np.roll(next_around, -1, axis=2)
    quads = np.stack([number, next_along, both, next_around], axis=-1)
    quads = quads.reshape(through + 1, -1, 4)
    hexahedra = np.concatenate([quads[:-1], quads[1:]], axis=-1).reshape(-1, 8)
    return hexahedra, quads[-1], quads[0, :, ::-1]


def turned_about_y(x, degrees):
    """Positions after a turn about the y axis; positive angles turn z towards x.

    Args:
        x: Positions [m], shape (..., 3).
        degrees: Angle [deg].
    """
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return x @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def two_tori(
    *, radius=76.0, tube=24.0, wall=4.5, tilt=-45.0, centre=(-137, 0, -105), cells=(1, 12, 24)
):
    """Make both tori in a new Gmsh model; Gmsh must be initialised.

    Args:
        radius: Of the rings, to the middle of the tube [m].
        tube: Outer radius of the tubes [m].
        wall: Thickness of their walls [m].
        tilt: Turn of the tilted torus about the y axis [deg].
        centre: Where its centre is moved [m].
        cells: Cells (through the wall, around the tube, along the ring).

    Returns:
        gmsh.model.
    """
    gmsh.model.add("two tori")
    # Half a cell apart: with equal meshes the nodes of one would stand over the edges of the other,
    # where the closest facet is a matter of rounding.
    flat = nodes_of_torus(radius, tube, wall, cells, (0.0, 0.5)).reshape(-1, 3)
    tilted = nodes_of_torus(radius, tube, wall, cells, (0.0, 0.0)).reshape(-1, 3)
    _add_torus("flat", 1, flat, cells)
    _add_torus("tilted", 2, turned_about_y(tilted, tilt) + np.asarray(centre), cells)
    return gmsh.model


def _add_torus(name, number, x, cells):
    """One torus as a discrete volume and two discrete surfaces."""
    hexahedra, outer, inner = cells_of_torus(cells)
    first = 1 + (number - 1) * len(x)
    model = gmsh.model
    surfaces = [2 * number - 1, 2 * number]
    for surface in surfaces:
        model.addDiscreteEntity(2, surface)
    model.addDiscreteEntity(3, number, surfaces)
    model.mesh.addNodes(3, number, np.arange(first, first + len(x)), x.ravel())
    model.mesh.addElementsByType(number, HEXAHEDRON, [], (first + hexahedra).ravel())
    for surface, quads in zip(surfaces, (outer, inner), strict=True):
        model.mesh.addElementsByType(surface, QUADRANGLE, [], (first + quads).ravel())
    group = model.addPhysicalGroup(3, [number], number)
    model.setPhysicalName(3, group, name)
    for surface, side in zip(surfaces, ("outer", "inner"), strict=True):
        model.setPhysicalName(2, model.addPhysicalGroup(2, [surface], surface), f"{name}_{side}")


def main():
    """Write the mesh that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path, help=".msh file to write (format 4.1, ASCII)")
    parser.add_argument("--radius", type=float, default=76.0, help="of the rings")
    parser.add_argument("--tube", type=float, default=24.0, help="outer radius of the tubes")
    parser.add_argument("--wall", type=float, default=4.5, help="thickness of the walls")
    parser.add_argument("--tilt", type=float, default=-45.0, help="about the y axis [deg]")
    parser.add_argument(
        "--centre", type=float, nargs=3, default=(-137, 0, -105), help="of the tilted torus"
    )
    parser.add_argument(
        "--cells", type=int, nargs=3, default=(1, 12, 24), help="through wall, around tube, along"
    )
    args = vars(parser.parse_args())
    path = args.pop("output")
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 2)
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    two_tori(**args)
    gmsh.write(str(path))
    gmsh.finalize()


if __name__ == "__main__":
    main()
