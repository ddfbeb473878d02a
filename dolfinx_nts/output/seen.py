"""What there is to see of a scene as it stands: facets of bodies, obstacles, joints and springs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.rigid.rigid import RigidBody
from dolfinx_nts.bodies.slender.director_body import DirectorBody
from dolfinx_nts.contact.linear_facets import body_facets, node_places
from dolfinx_nts.contact.obstacles import Obstacle
from dolfinx_nts.interaction.sketch import Sketch, joined
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.output.colours import Colour, at_corners, number
from dolfinx_nts.parallel import gather_on_root
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import items

#: How far from the bodies' box obstacles and ends of springs may be to have room in a picture, as
#: part of its diagonal.
_FAR = 1.0


class Given(NamedTuple):
    """What a picture is asked to show.

    Attributes:
        bodies: Those with a mesh.
        system: Whose obstacles and joints are shown, too; None: bodies alone.
        run: What has its contacts' forces; None: a scene alone.
        time: Where obstacles stand [s].
        hidden: Bodies and obstacles that are left out.
    """

    bodies: tuple[Any, ...]
    system: System | None
    run: Any
    time: float
    hidden: tuple[Any, ...] = ()

    @classmethod
    def of(cls, name: str, scene: Any, hide: Any = ()) -> Given:
        """A run, a scene, or bodies, less bodies and obstacles or those of these names.

        Raises:
            TypeError: It is none, or an item of `hide`.
            ValueError: There is nothing to be seen of its bodies, or nothing to hide.
        """
        run = scene if hasattr(scene, "system") and hasattr(scene, "state") else None
        system = scene if run is None else run.system
        if isinstance(system, System):
            bodies = tuple(b for b in system.bodies if b.mesh is not None)
        else:
            wanted = "bodies with a mesh, or a System or what simulate(...) returns"
            system, run, bodies = None, None, items(name, scene, _has_mesh, wanted)
        if not bodies and not (system and system.declared_joints):
            raise ValueError(
                f"{name}={scene!r}: pass at least one body with a mesh; of bodies without one, the "
                "joints are drawn, of which it has none"
            )
        time = 0.0 if run is None or run.state is None else run.state.time
        given = cls(bodies, system, run, time)
        given = given._replace(hidden=given._those("hide", hide))
        if bodies and not given.shown:
            raise ValueError(f"hide={hide!r}: leave one of {[b.name for b in bodies]} to be seen")
        return given

    def _those(self, name: str, wanted: Any) -> tuple[Any, ...]:
        """Bodies and obstacles by themselves or their names."""
        there = [*self.bodies, *self.obstacles]
        each = "bodies and obstacles, or their names"
        if isinstance(wanted, str):
            raise TypeError(f"{name}={wanted!r}: pass a sequence of {each}, such as [{wanted!r}]")
        wanted = items(name, wanted, lambda a: isinstance(a, str | Body | Obstacle), each)
        for item in wanted:
            if not any(item is x or item == x.name for x in there):
                names = [x.name for x in there]
                raise ValueError(f"{name}: {item!r} is not there; pass some of {names}")
        return tuple(x for x in there if any(item is x or item == x.name for item in wanted))

    @property
    def shown(self) -> tuple[Any, ...]:
        """Bodies that are not hidden."""
        return tuple(body for body in self.bodies if not self.hides(body))

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """All of the scene, also what is hidden."""
        masters = [p.master for p in self.system.contacts] if self.system else []
        return tuple({id(m): m for m in masters if isinstance(m, Obstacle)}.values())

    def hides(self, item: Any) -> bool:
        """Whether a body or an obstacle is hidden."""
        return any(item is x for x in self.hidden)

    @property
    def comm(self) -> Any:
        """MPI communicator."""
        return self.system.comm if self.system else self.bodies[0].comm


def _has_mesh(body: Any) -> bool:
    return isinstance(body, Body) and body.mesh is not None


class Drawn(NamedTuple):
    """Facets of a body.

    Attributes:
        name: Of the body.
        corners: Places [m], shape (m, 4, 3), a triangle's last one twice, counter-clockwise from
            outside.
        values: What is coloured, at the corners, shape (m, 4); NaN is grey.
    """

    name: str
    corners: FloatArray
    values: FloatArray


class Seen(NamedTuple):
    """What is there at a time, on rank 0.

    Attributes:
        drawn: Facets of the bodies.
        sketch: Lines, points and axes of joints, springs and cables, and of bodies without facets.
        obstacles: Obstacles, and their displacements [m], (3,).
    """

    drawn: list[Drawn]
    sketch: Sketch
    obstacles: list[tuple[Obstacle, FloatArray]]

    @property
    def points(self) -> FloatArray:
        """Bodies, and what of joints is not far from them [m], shape (n, 3)."""
        bodies = np.concatenate([np.empty((0, 3)), *(d.corners.reshape(-1, 3) for d in self.drawn)])
        others = np.concatenate([a.reshape(-1, 3) for a in self.sketch[:2]])
        if not len(bodies):
            return others
        low, high = bodies.min(axis=0), bodies.max(axis=0)
        away = np.linalg.norm(others - others.clip(low, high), axis=1)
        return np.concatenate([bodies, others[away <= _FAR * np.linalg.norm(high - low)]])


def seen(given: Given, colour: Colour) -> Seen:
    """What is to be seen now. Collective."""
    drawn, sketches = [], []
    for k, body in enumerate(given.bodies):
        if given.hides(body):
            continue
        if not _has_facets(body):
            sketches.append(Sketch(lines=gather_on_root(body.comm, _edges(body))))
            continue
        corners, values = _facets(body, "speed" if colour == "body" else colour, given.run)
        if colour == "body":
            values = np.full_like(values, number(k))
        both = (gather_on_root(body.comm, a) for a in (corners, values))
        drawn.append(Drawn(body.name, *both))
    if given.system is None:
        return Seen(drawn, joined(sketches), [])
    comm = given.comm
    for joint in given.system.declared_joints:
        u = [body.last_accepted()[0] for body in joint.bodies]
        sketch = joint.sketch(u, given.time)
        sketches += [sketch, _sticks(joint, sketch.points)]
    there = [m for m in given.obstacles if not given.hides(m)]
    obstacles = [(m, m.displacement(given.time, comm)) for m in there]
    return Seen(drawn, joined(sketches), obstacles)


def _sticks(joint: Any, points: FloatArray) -> Sketch:
    """Lines from centres of rigid bodies without a mesh to the nearest point of a joint."""
    bare = [b.position for b in joint.bodies if isinstance(b, RigidBody) and b.mesh is None]
    if not bare or not len(points):
        return Sketch(points=np.reshape(bare, (-1, 3)))
    centres = np.array(bare)
    apart = np.linalg.norm(centres[:, None] - points, axis=2)
    return Sketch(np.stack([centres, points[apart.argmin(axis=1)]], axis=1), centres)


def _has_facets(body: Any) -> bool:
    """Whether a body has an outside: beams without an outline, lines and membranes have none."""
    if isinstance(body, DirectorBody):
        return body.has_skin
    return bool(body.mesh.topology.dim == 3)


#: Vertices of the edges of DOLFINx's cells.
_EDGES = {
    "interval": [(0, 1)],
    "triangle": [(0, 1), (1, 2), (2, 0)],
    "quadrilateral": [(0, 1), (1, 3), (3, 2), (2, 0)],
}


def _edges(body: Any) -> FloatArray:
    """Edges of this rank's cells of a body without facets, deformed [m], shape (l, 2, 3)."""
    mesh = body.mesh
    owned = mesh.topology.index_map(mesh.topology.dim).size_local
    blocks = compat.node_blocks(mesh, body.space)[compat.geometry_dofmap(mesh)[:owned]]
    ends = blocks[:, _EDGES[compat.cell_name(mesh)]].reshape(-1, 2)
    return node_places(body)[ends] + body.u.x.array.reshape(-1, 3)[ends]


def _facets(body: Any, colour: Colour, run: Any) -> tuple[FloatArray, FloatArray]:
    """This rank's facets: deformed corners [m], (m, 4, 3), and values there, (m, 4)."""
    if isinstance(body, DirectorBody):
        skin, (u, v) = body.boundary(), body.last_accepted()
        mine = skin.facets[body.comm.rank :: body.comm.size]
        speed = np.linalg.norm(skin.gather(v), axis=1)[mine]
        return skin.positions(u)[mine], speed if colour == "speed" else np.full_like(speed, np.nan)
    local = compat.exterior_facets(body.mesh)
    blocks = body_facets(body, local).corners[:, [0, 1, 2, -1]]
    corners = node_places(body)[blocks] + body.u.x.array.reshape(-1, 3)[blocks]
    to_cell = body.mesh.topology.connectivity(2, 3)
    cells = np.array([to_cell.links(f)[0] for f in local], dtype=np.int64)
    parts = len(blocks) // max(len(cells), 1)
    return corners, at_corners(body, colour, run, blocks, np.repeat(cells, parts))


# ---- obstacles
#: Cells along the longest side of the box in which obstacles are drawn, and what it is larger by
#: than the bodies' own, as part of its diagonal.
_CELLS, _MARGIN = 48, 0.08


def obstacle_facets(everything: Sequence[Seen]) -> list[tuple[FloatArray, FloatArray]]:
    """Facets of obstacles around the bodies, of whatever shape, in each of what is seen.

    Returns:
        Corners [m], shape (m, 4, 3), and unit normals towards the bodies, (m, 3).
    """
    low, high = _stage(everything)
    size = float((high - low).max()) / _CELLS
    counts = np.ceil((high - low) / size).astype(int)
    none, known, found = (np.empty((0, 4, 3)), np.empty((0, 3))), {}, []
    for now in everything:
        each = [none]
        for obstacle, moved in now.obstacles:
            place = id(obstacle), moved.tobytes()
            if place not in known:
                corners, normals = _zero_surface(obstacle, low - moved, size, counts)
                known[place] = corners + moved, normals
            each.append(known[place])
        corners, normals = (np.concatenate(part) for part in zip(*each, strict=True))
        found.append((corners, normals))
    return found


def _stage(all_seen: Sequence[Seen]) -> tuple[FloatArray, FloatArray]:
    """Corners of the box that holds all bodies and the obstacles next to them [m], (3,) each."""
    every = [s.points for s in all_seen]
    low, high = np.min([x.min(axis=0) for x in every], 0), np.max([x.max(axis=0) for x in every], 0)
    size = float(np.linalg.norm(high - low))
    middle, ends = 0.5 * (low + high), [low, high]
    for now in all_seen:
        for obstacle, moved in now.obstacles:
            gap = obstacle.gap((middle - moved)[None])
            nearest, width = middle - gap.value[0] * gap.gradient[0, 0], obstacle.width
            if np.linalg.norm(nearest - nearest.clip(low, high)) > _FAR * size:
                continue
            ends.append(nearest)
            if width <= _FAR * size:  # small enough to be drawn whole, or a piece as long as wide
                inner = nearest - width * gap.gradient[0, 0]
                ends += [inner - width, inner + width]
    return np.min(ends, axis=0) - _MARGIN * size, np.max(ends, axis=0) + _MARGIN * size


def _zero_surface(
    obstacle: Obstacle, low: FloatArray, size: float, counts: Any
) -> tuple[FloatArray, FloatArray]:
    """Where the gap is zero in a grid of cells of a size [m]: facets, and their unit normals.

    Each cell through which the surface goes has a vertex, which is next to its middle on the
    surface; each edge that goes through it a facet of the vertices around it ("surface nets").
    """
    grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in counts), indexing="ij"), axis=-1)
    behind = obstacle.gap((low + size * grid).reshape(-1, 3)).value.reshape(grid.shape[:3]) < 0.0
    facets = []
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        turned = np.moveaxis(behind, (axis, one, two), (0, 1, 2))
        through = turned[1:] != turned[:-1]
        edge = np.argwhere(through[:, 1:-1, 1:-1]) + [0, 1, 1]
        around = edge[:, None] - np.array([[0, 1, 1], [0, 0, 1], [0, 0, 0], [0, 1, 0]])
        cells = np.empty_like(around)
        cells[..., [axis, one, two]] = around
        facets.append(cells)
    middles = low + size * (np.concatenate(facets).reshape(-1, 3) + 0.5)
    gap = obstacle.gap(middles)
    corners = (middles - gap.value[:, None] * gap.gradient[:, 0]).reshape(-1, 4, 3)
    normals = gap.gradient[:, 0].reshape(-1, 4, 3).sum(axis=1)
    # Counter-clockwise from where bodies are.
    across = cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    turned = np.einsum("ni,ni->n", across, normals) < 0.0
    corners[turned] = corners[turned][:, ::-1]
    return corners, normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-300)
