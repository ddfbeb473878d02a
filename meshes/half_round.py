"""Half cylinders and half spheres of hexahedra, fine where they touch and coarse elsewhere.

The body has the radius R; its round side touches the plane z = 0 at the origin, its flat face is
z = R. A block of n cells an edge sits on the round side at the origin; from its other faces, rings
of cells grow to the flat face. A cylinder lies along y and is one cell long; a sphere is cut to the
quarter x, y >= 0.

The grid is made in lattice points (i, j, k, ring): (i, j, k) of the block, and how many rings
outward from its surface.
"""

import numpy as np

#: Corners of a hexahedron in DOLFINx's order, as steps along three axes.
CORNERS = np.array([[v & 1, v >> 1 & 1, v >> 2] for v in range(8)])
#: Each ring is exp(GROWTH / n) times as thick as the one before, so that meshes refine evenly.
GROWTH = 3.0


def half_cylinder(n, radius, block, *, whole):
    """Half a cylinder, of the length of a cell.

    Args:
        n: Cells from the middle of the block to its side, and over its height.
        radius: Of the cylinder [m].
        block: Half width and height of the block [m].
        whole: Both sides of x = 0, or only x >= 0.

    Returns:
        Cells (m, 8) in DOLFINx's order and points (p, 3) [m].
    """
    faces = [(0, 1), (2, 1)] + [(0, -1)] * whole
    cells, lattice = _grid((-n * whole, 0, 0), (n, 1, n), faces, _rings(n, radius, block))
    along = block / n * lattice[:, 1]
    lattice[:, 1] = 0
    points = _points(lattice, n, radius, block)
    points[:, 1] = along
    return cells, points


def half_sphere(n, radius, block):
    """A quarter of half a sphere.

    Args:
        n: Cells along an edge of the block.
        radius: Of the sphere [m].
        block: Edge of the block [m].

    Returns:
        Cells (m, 8) in DOLFINx's order and points (p, 3) [m].
    """
    faces = [(0, 1), (1, 1), (2, 1)]
    cells, lattice = _grid((0, 0, 0), (n, n, n), faces, _rings(n, radius, block))
    return cells, _points(lattice, n, radius, block)


def _rings(n, radius, block):
    """Number of rings that fill the body if the first is as thick as a cell of the block."""
    growth = np.exp(GROWTH / n)
    return round(np.log1p((growth - 1) * (radius - block) * n / block) * n / GROWTH)


def _grid(low, high, faces, rings):
    """Cells (m, 8) and lattice points (p, 4): a block, and rings on its faces (axis, side)."""
    spans = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    parts = [_cells(*spans, [0], steps=np.pad(CORNERS, ((0, 0), (0, 1))))]
    for axis, side in faces:
        steps = np.pad(CORNERS, ((0, 0), (0, 1)))
        # Outwards takes the place of the axis; turned about on a negative side, cells stay upright.
        steps[:, 3] = steps[:, axis] if side > 0 else 1 - steps[:, axis]
        steps[:, axis] = 0
        on_face = list(spans)
        on_face[axis] = [high[axis] if side > 0 else low[axis]]
        parts.append(_cells(*on_face, np.arange(rings), steps=steps))
    lattice, cells = np.unique(np.concatenate(parts).reshape(-1, 4), axis=0, return_inverse=True)
    return cells.reshape(-1, 8), lattice


def _cells(*spans, steps):
    """Corners (m, 8, 4) of cells whose first corners span a grid."""
    first = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 1, 4)
    return first + steps


def _points(lattice, n, radius, block):
    """Positions [m] of lattice points, shape (p, 3).

    Between block and flat face, rings are blended linearly; on the round side they follow it.
    """
    q, ring = lattice[:, :3] / n, lattice[:, 3:]
    growth, last = np.exp(GROWTH / n), max(ring.max(), 1)
    out = (growth**ring - 1) / (growth**last - 1)
    side = np.abs(q[:, :2]).max(axis=1, keepdims=True)
    edge = np.where(side > 0, q[:, :2] / np.where(side > 0, side, 1.0), [1.0, 0.0])
    height = q[:, 2:]

    inner = _on_sphere(block * q[:, :2], radius)
    inner[:, 2:] += block * height
    rim = np.column_stack([radius * _unit(edge), np.full(len(q), radius)])
    top = np.column_stack([radius / 2 * q[:, :2], np.full(len(q), radius)])
    outer = (1 - height) * rim + height * top

    start = _on_sphere(block * edge, radius)
    centre = np.array([0.0, 0.0, radius])
    arc = centre + radius * _between(start - centre, rim - centre, out)
    bulge = arc - (1 - out) * start - out * rim
    return (1 - out) * inner + out * outer + (1 - (height + 1 - side) / 2) * bulge


def _on_sphere(xy, radius):
    """The points of the round side above (x, y), shape (p, 3)."""
    return np.column_stack([xy, radius - np.sqrt(radius**2 - (xy**2).sum(axis=1))])


def _unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _between(a, b, part):
    """Unit vectors (p, 3) that turn evenly from the direction of a to that of b."""
    a, b = _unit(a), _unit(b)
    angle = np.arccos(np.clip((a * b).sum(axis=1, keepdims=True), -1.0, 1.0))
    return (np.sin((1 - part) * angle) * a + np.sin(part * angle) * b) / np.sin(angle)
