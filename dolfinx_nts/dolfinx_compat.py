"""What differs between DOLFINx 0.5.2, 0.9 and 0.11 (and their PETSc), and nothing else."""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import logging
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mpi4py import MPI

import cffi
import dolfinx
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import cpp, fem, geometry, jit, mesh
from dolfinx.mesh import Mesh
from ffcx.codegeneration import jit as ffcx_jit
from petsc4py import PETSc
from ufl.core.expr import Expr

from dolfinx_nts.kernels import library
from dolfinx_nts.kernels.canonical import canonical
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray, IntArray

logger = logging.getLogger(__name__)

VERSION = tuple(int(i) for i in dolfinx.__version__.split(".")[:2])
#: UFL-owned elements, AdjacencyList dofmaps.
OLD = VERSION < (0, 8)
_SHARED = mesh.GhostMode.shared_facet
#: Cells of degree 2 and their nodes.
_CURVED = {("interval", 3), ("tetrahedron", 10), ("hexahedron", 27)}
#: What FFCx has loaded, by its C file: it lists the whole cache to load one again.
_LOADED: dict[Path, Any] = {}


# ---- meshes
def _ghosts() -> dict[str, Any]:
    """What gives a mesh shared-facet ghosts, as an argument of the function that makes it."""
    if not hasattr(mesh, "create_cell_partitioner"):  # after 0.11
        return {"ghost_mode": _SHARED}
    links = () if VERSION < (0, 11) else (2,)
    return {"partitioner": mesh.create_cell_partitioner(_SHARED, *links)}


def create_mesh(comm: MPI.Comm, cells: npt.ArrayLike, x: npt.ArrayLike, cell_type: str) -> Mesh:
    """Mesh of degree 1, or of degree 2 where cells have as many nodes, with shared-facet ghosts.

    Args:
        comm: MPI communicator.
        cells: This rank's part of the cells in DOLFINx order, shape (m, nodes): their corners,
            then, of degree 2, the middles of edges, of faces and of the cell.
        x: This rank's part of the points [m], shape (n, 3).
        cell_type: Of DOLFINx, e.g. "hexahedron", "tetrahedron", "quadrilateral", "interval".

    Raises:
        ValueError: Several ranks give the same cells.
    """
    cells, x = np.ascontiguousarray(cells, np.int64), np.ascontiguousarray(x, np.float64)
    _refuse_whole(comm, cells, x)
    degree = 2 if (cell_type, cells.shape[1]) in _CURVED else 1
    if OLD:
        cell = ufl.Cell(cell_type, geometric_dimension=x.shape[1])
        domain = ufl.Mesh(ufl.VectorElement("Lagrange", cell, degree))
        return mesh.create_mesh(comm, cells, x, domain, _SHARED, mesh.create_cell_partitioner())
    basix_ufl = importlib.import_module("basix.ufl")
    e = basix_ufl.element("Lagrange", cell_type, degree, shape=(x.shape[1],))
    args = (x, e) if VERSION < (0, 10) else (e, x)
    return mesh.create_mesh(comm, cells, *args, **_ghosts())


def _refuse_whole(comm: MPI.Comm, cells: IntArray, x: FloatArray) -> None:
    """Raise on every rank if two give the same cells, of the same points or of a copy of them."""
    if comm.size == 1:
        return
    low = cells.min(initial=np.iinfo(np.int64).max)
    parts = (cells.tobytes(), (cells - low).tobytes() + x.tobytes())
    own = [hashlib.sha256(part).digest() for part in parts] if len(cells) else None
    given = comm.allgather(own)
    problem = None
    for rank, other in enumerate(given[: comm.rank]):
        if own and other and any(a == b for a, b in zip(own, other, strict=True)):
            problem = problem or (
                f"cells: ranks {rank} and {comm.rank} give the same {len(cells)} cells; give each "
                "cell on one rank, e.g. all cells and points on rank 0 and arrays without rows, "
                f"np.empty((0, {cells.shape[1]})) and np.empty((0, {x.shape[1]})), on the others"
            )
    raise_together(comm, problem)


def model_to_mesh(model: Any, comm: MPI.Comm, rank: int = 0) -> tuple[Any, Any, Any]:
    """Gmsh model -> (mesh, cell tags, facet tags), with shared-facet ghosts in every version."""
    if OLD:
        gmshio = importlib.import_module("dolfinx.io.gmshio")
        m, ct, ft = gmshio.model_to_mesh(model, comm, rank, 3)
        return m, ct, ft
    io = importlib.import_module("dolfinx.io.gmshio" if VERSION < (0, 10) else "dolfinx.io.gmsh")
    m, ct, ft = tuple(io.model_to_mesh(model, comm, rank, 3, **_ghosts()))[:3]
    return m, ct, ft


def _table(a: Any, layout: Any) -> IntArray:
    """Rows of a list, which does not know how long they are where there is none."""
    return np.asarray(a.array).reshape(a.num_nodes, layout.num_dofs)


def geometry_dofmap(msh: Mesh) -> IntArray:
    """Geometry nodes of the cells, shape (cells, nodes)."""
    g = msh.geometry
    if OLD:
        return _table(g.dofmap, g.cmap.create_dof_layout())
    return g.dofmaps[0] if hasattr(g, "dofmaps") else g.dofmap


def coordinate_map(msh: Mesh) -> Any:
    """How the cells' points of reference are mapped to their geometry nodes."""
    g = msh.geometry
    return g.cmaps[0] if hasattr(g, "cmaps") else g.cmap


def cell_dofs(space: fem.FunctionSpace) -> IntArray:
    """Blocked dofs of the cells, shape (cells, dofs)."""
    if OLD:
        return _table(space.dofmap.list, space.dofmap.dof_layout)
    return space.dofmap.list


def entities_to_geometry(msh: Mesh, dim: int, entities: npt.ArrayLike) -> IntArray:
    """Geometry nodes of the vertices of entities, shape (entities, vertices), tensor-ordered."""
    entities, t = np.asarray(entities, dtype=np.int32), msh.topology
    t.create_connectivity(dim, t.dim)
    t.create_connectivity(t.dim, dim)
    t.create_connectivity(dim, 0)
    if not entities.size:  # 0.9 raises SIGFPE on an empty list
        kind = cpp.mesh.cell_entity_type(t.cell_type, dim, 0)
        return np.empty((0, cpp.mesh.cell_num_vertices(kind)), np.int32)
    if OLD:
        nodes: IntArray = cpp.mesh.entities_to_geometry(_cpp_mesh(msh), dim, entities, False)
    else:
        nodes = mesh.entities_to_geometry(msh, dim, entities)
    # Of curved cells later versions have all nodes, those of the vertices first.
    kind = cpp.mesh.cell_entity_type(t.cell_type, dim, 0)
    return nodes[:, : cpp.mesh.cell_num_vertices(kind)]


def _cpp_mesh(msh: Mesh) -> Any:
    return getattr(msh, "_mesh", msh)


def exterior_facets(msh: Mesh) -> IntArray:
    """Owned exterior facets, sorted."""
    t = msh.topology
    t.create_connectivity(t.dim - 1, t.dim)
    return np.sort(mesh.exterior_facet_indices(t))


def is_tagging(tags: Any, msh: Mesh) -> bool:
    """Whether meshtags are of this mesh, or of one with the same cells of the same vertices."""
    theirs = getattr(tags, "mesh", tags).topology  # only 0.5 has a mesh there
    cells = [t.connectivity(t.dim, 0).array for t in (theirs, msh.topology)]
    return bool(np.array_equal(*cells))


def cell_name(msh: Mesh) -> str:
    """Name of the mesh's cell type, e.g. "hexahedron"."""
    name = str(msh.topology.cell_type)
    return name.rsplit(".", maxsplit=1)[-1]


def create_submesh(msh: Mesh, dim: int, entities: npt.ArrayLike) -> tuple[Any, IntArray, IntArray]:
    """Submesh and two int32 arrays: sub entity -> parent entity, sub node -> parent node."""
    s, e, _, g = mesh.create_submesh(msh, dim, np.asarray(entities, dtype=np.int32))
    if hasattr(e, "sub_topology_to_topology"):
        im = s.topology.index_map(dim)
        every = np.arange(im.size_local + im.num_ghosts, dtype=np.int32)
        e = e.sub_topology_to_topology(every, False)
    return s, np.asarray(e), np.asarray(g)


# ---- spaces and functions
@contextmanager
def without_floats() -> Iterator[None]:
    """Refuse a float of an expression, which what makes one in UFL has no value for yet.

    UFL of 0.5 tries again and again, with a warning each time, and does not end; a Constant of
    later versions hands over its value of now, as if it were one for all times.
    """

    def refuse(expression: Any) -> float:
        raise TypeError(
            f"{type(expression).__name__} has no value yet: take ufl.sin, ufl.ln, ... in place of "
            "math.sin, math.log"
        )

    kinds = [kind for kind in (Expr, fem.Constant) if "__float__" in vars(kind)]
    before = [kind.__float__ for kind in kinds]
    for kind in kinds:
        kind.__float__ = refuse
    try:
        yield
    finally:
        for kind, known in zip(kinds, before, strict=True):
            kind.__float__ = known


@contextmanager
def _told_compiler(what: str) -> Iterator[list[Path]]:
    """Tell in one line that something is compiled, which is not in FFCx's cache, and nothing else.

    0.5.2 sends the C compiler's progress to the root logger, whose level it raises itself. Of
    spaces, too: their elements are compiled. Errors are still raised, and what a compiler says of
    them is printed.

    Yields:
        The C files that FFCx takes or makes, one after the other.

    Raises:
        RuntimeError: The C compiler fails, or is not there.
    """
    before, look = logging.root.manager.disable, ffcx_jit.get_cached_module
    told, sources = False, []

    def looked(*arguments: Any) -> Any:
        nonlocal told
        source = Path(arguments[2], f"{arguments[0]}.c")
        sources.append(source)
        if source in _LOADED:
            return _LOADED[source]
        found = look(*arguments)
        if found[0] is not None:
            _LOADED[source] = found
        if found[0] is None and not told:
            logger.info("compiling %s, which is kept in %s", what, arguments[2])
            logging.disable(logging.INFO)
            told = True
        return found

    ffcx_jit.get_cached_module = looked
    try:
        yield sources
    except Exception as error:
        # On rank 0 of several DOLFINx has put setuptools' error into one of its own.
        if not re.search(r"\b(Compile|Link)Error: ", str(error)):
            raise
        raise RuntimeError(f"{what} cannot be compiled ({error}): {library.COMPILER}") from None
    finally:
        ffcx_jit.get_cached_module = look
        logging.disable(before)


def vector_space(msh: Mesh, degree: int) -> fem.FunctionSpace:
    """Continuous Lagrange space of 3-vectors."""
    return function_space(msh, "Lagrange", degree, (3,))


def lagrange_degree(space: fem.FunctionSpace) -> int | None:
    """Degree of a continuous Lagrange space of 3-vectors, None of any other."""
    element = space.ufl_element()
    if OLD:
        family, degree, broken = element.family(), element.degree(), False
    elif not hasattr(element, "basix_element"):
        return None
    else:
        family, degree, broken = element.family_name, element.degree, element.discontinuous
    vectors = space.dofmap.index_map_bs == 3 and space.num_sub_spaces == 3
    known = str(family) in {"Lagrange", "Q", "CG", "P"} and not broken
    return int(degree) if vectors and known else None


def is_nodal(space: fem.FunctionSpace, msh: Mesh) -> bool:
    """Whether a space is of Lagrange elements with one block at each corner, or at each node."""
    element = space.ufl_element()
    if OLD:
        scalar = (*element.sub_elements(), element)[0]
        broken = scalar.family() not in ("Lagrange", "Q")
    else:
        broken = element.discontinuous
    corners = cpp.mesh.cell_num_vertices(msh.topology.cell_type)
    return cell_dofs(space).shape[1] in (corners, geometry_dofmap(msh).shape[1]) and not broken


def function_space(
    msh: Mesh, family: str, degree: int, shape: tuple[int, ...] = ()
) -> fem.FunctionSpace:
    """Space of the family ("Lagrange" or "DG") of scalars, 3-vectors or 3 x 3 tensors."""
    if OLD:
        if family == "DG" and cell_name(msh) == "hexahedron":
            family = "DQ"
        with _told_compiler("an element"):
            if not shape:
                return fem.FunctionSpace(msh, (family, degree))
            if len(shape) == 1:
                return fem.VectorFunctionSpace(msh, (family, degree), dim=3)
            return fem.TensorFunctionSpace(msh, (family, degree), shape=shape)
    return fem.functionspace(msh, (family, degree, *([shape] if shape else [])))


def node_blocks(mesh: Mesh, space: fem.FunctionSpace) -> IntArray:
    """Block of coordinates of each geometry node of this rank, ghosts included, shape (nodes,).

    Without one, as between the corners of a curved cell in a space of degree 1, it is -1.
    """
    nodes, dofs = geometry_dofmap(mesh), cell_dofs(space)
    both = min(nodes.shape[1], dofs.shape[1])
    blocks = np.full(len(mesh.geometry.x), -1, dtype=np.int64)
    blocks[nodes[:, :both]] = dofs[: len(nodes), :both]
    return blocks


def cells_near(msh: Mesh, x: FloatArray, padding: float) -> list[list[int]]:
    """This rank's own cells whose boxes, padded [m], hold each point (n, 3)."""
    dim = msh.topology.dim
    make = geometry.BoundingBoxTree if OLD else geometry.bb_tree
    collide = geometry.compute_collisions if OLD else geometry.compute_collisions_points
    found = collide(make(msh, dim, padding=padding), np.ascontiguousarray(x, dtype=np.float64))
    owned = msh.topology.index_map(dim).size_local
    return [[int(c) for c in found.links(i) if c < owned] for i in range(len(x))]


def with_ghosts(space: fem.FunctionSpace, chosen: IntArray) -> npt.NDArray[np.bool_]:
    """Return which coordinates of nodes and ghosts are among chosen owned ones, (b, 3)."""
    mark = fem.Function(space)
    mark.x.array[chosen] = 1.0
    mark.x.scatter_forward()
    return mark.x.array.reshape(-1, 3) > 0.5


def subspace_component_bc(space: fem.FunctionSpace, component: int, blocked_dofs: IntArray) -> Any:
    """Homogeneous DirichletBC on one component of blocked dofs; it only masks rows and columns."""
    dofs = np.sort(np.asarray(blocked_dofs, np.int32) * 3 + component)
    return fem.dirichletbc(PETSc.ScalarType(0.0), dofs, space.sub(component))


# ---- forms and assembly
#: No result changes: without errno and traps a branch that is not taken is not computed. Python's
#: own flags ask for what only debuggers need, which takes a fifth of the compiler's time, and for
#: -O2, which takes another quarter and makes matrices faster by 2 %.
C_FLAGS = ["-O1", "-g0", "-fno-math-errno", "-fno-trapping-math"]
#: Time [s] that a rank waits for another one that compiles.
_PATIENCE = 600


def _jit_options() -> tuple[dict[str, Any], dict[str, Any]]:
    """DOLFINx's options of the compiler, as they are and as they are by default."""
    named = "PARAMETERS" if OLD else "OPTIONS"
    defaults = getattr(jit, f"DOLFINX_DEFAULT_JIT_{named}")
    chosen = getattr(jit, f"get_{named.lower()}")()
    return chosen, {name: default[0] for name, default in defaults.items()}


def jit_options() -> dict[str, Any]:
    """What differs from DOLFINx's defaults when forms are compiled, but for what a user chose.

    A file `dolfinx_jit_options.json` (0.5.2: `dolfinx_jit_parameters.json`) in the working folder
    or in `~/.config/dolfinx` is the user's choice.
    """
    chosen, defaults = _jit_options()
    ours = {"cffi_extra_compile_args": C_FLAGS, "timeout": _PATIENCE}
    return {name: value for name, value in ours.items() if chosen[name] == defaults[name]}


def chosen_flags() -> list[str]:
    """The C compiler's flags that a user chose in that file."""
    name = "cffi_extra_compile_args"
    chosen, defaults = (options[name] for options in _jit_options())
    return [] if chosen == defaults else list(chosen)


def cache_folder() -> Path:
    """Where DOLFINx keeps what it compiles."""
    return Path(_jit_options()[0]["cache_dir"])


def compile_forms(forms: Iterable[Any]) -> Iterator[tuple[Any, Path]]:
    """Compiled forms one by one, each with FFCx's C code of it."""
    options = jit_options()
    given: dict[str, Any] = {"jit_options": options}
    if OLD:
        given = {"jit_params": options, "form_compiler_params": {}}
    with _told_compiler("forms of a material or mesh that is new here") as sources:
        for form in map(canonical, forms):
            if OLD:
                # Compiling a form sets this on its mesh, and so would change the next signature.
                for domain in form.ufl_domains():
                    domain.ufl_coordinate_element()._sub_element._variant = "equispaced"
            yield fem.form(form, **given), sources[-1]


def constants(form: Any) -> FloatArray:
    """Values of a compiled form's Constants, shape (n,)."""
    return cpp.fem.pack_constants(getattr(form, "_cpp_object", form))


def functions(form: Any, compiled: Any) -> list[Any]:
    """The Functions of a form in the order in which its kernel takes them."""
    given, made = form.coefficients(), compiled.ufcx_form
    place = made.original_coefficient_position if OLD else made.original_coefficient_positions
    return [given[place[k]] for k in range(made.num_coefficients)]


def cell_kernel(form: Any) -> Any:
    """FFCx's kernel of a compiled form's first integral, of six arrays and what it does not need.

    They are entries, coefficients, constants and coordinates, see `ufcx_tabulate_tensor_float64`.
    """
    made = form.ufcx_form
    first = made.form_integrals[0] if hasattr(made, "form_integrals") else made.integrals(0)[0]
    address = int(cffi.FFI().cast("uintptr_t", first.tabulate_tensor_float64))
    return ctypes.CFUNCTYPE(None, *(ctypes.c_void_p,) * 7)(address)


def plain_dofs(space: fem.FunctionSpace, cells: int) -> IntArray | None:
    """Blocks of dofs of the first cells as a kernel takes them, (cells, blocks).

    None where the dofs of a cell are turned by how its neighbours are numbered, or where their list
    is not what its layout says, as of a part of a mixed space.
    """
    if space.element.needs_dof_transformations:
        return None
    dofs = space.dofmap.list
    if OLD:
        if len(dofs.array) != dofs.num_nodes * space.dofmap.dof_layout.num_dofs:
            return None
        dofs = _table(dofs, space.dofmap.dof_layout)
    return np.asarray(dofs[:cells])
