"""A problem of your own: your UFL, your SNES, and contact elements added by hand.

Problem. A rubber block, 1 x 1 x 0.5, stands on a fixed base. A rigid ball of radius 0.6 is pressed
0.1 into its top in ten load steps. The block's weak form, its function space, its boundary
condition and the SNES are this script's; `nts.ContactTerms` finds which nodes may touch and adds
residual and tangent of contact to yours, see `solve` and `by_hand`: thirty lines.

What to see. The same as `nts.equilibrium` on the same scene gives, which the script prints beside
its own: contact force and number of nodes in contact.

    mpirun -n 2 python demos/own_problem.py
"""

import argparse
from pathlib import Path

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode, create_box
from petsc4py import PETSc
from tqdm import tqdm

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.output import Fields
from dolfinx_nts.output.pictures import picture

HEIGHT, RADIUS, DEPTH = 0.5, 0.6, 0.1
MU, LAMBDA = 4e5, 6e5


def energy(f):
    """The strain energy [J/m^3] of this problem, of the deformation gradient."""
    j = ufl.det(f)
    return 0.5 * MU * (ufl.tr(f.T * f) - 3 - 2 * ufl.ln(j)) + 0.5 * LAMBDA * ufl.ln(j) ** 2


def ball():
    """It touches the block at the start and goes down with pseudo time."""
    top = (0.5, 0.5, HEIGHT + RADIUS)
    return nts.Sphere(top, RADIUS, motion=lambda t: (0.0, 0.0, -DEPTH * t))


class Block(nts.Body):
    """Weak form of the block in UFL: what contact asks of a body, and forces and matrix."""

    name = "block"

    def __init__(self, mesh):
        self.mesh, self.comm, self.space = mesh, mesh.comm, compat.vector_space(mesh, 1)
        self.u = fem.Function(self.space)
        w, du = ufl.TestFunction(self.space), ufl.TrialFunction(self.space)
        dx = ufl.dx(metadata={"quadrature_degree": 2})
        work = ufl.derivative(energy(ufl.Identity(3) + ufl.grad(self.u)) * dx, self.u, w)
        slope = ufl.derivative(work, self.u, du)
        self._force, self._stiffness = compile_forms([work, slope])
        self._vector, self._matrix = (
            petsc_compat.create_vector(self.space), petsc_compat.create_matrix(self._stiffness)
        )  # fmt: skip
        self.num_owned = 3 * self.space.dofmap.index_map.size_local
        self.reference = self.space.tabulate_dof_coordinates().ravel()[: self.num_owned]
        self.fixed = np.flatnonzero(self.reference[2::3].repeat(3) < 1e-9)
        base = fem.locate_dofs_geometrical(self.space, lambda x: x[2] < 1e-9)
        self._bcs = [compat.subspace_component_bc(self.space, i, base) for i in range(3)]

    def at(self, u):
        """Take displacements [m] of this rank."""
        self.u.x.array[: self.num_owned] = u
        self.u.x.scatter_forward()

    def force(self):
        """Internal forces [N]."""
        assemble_vector(self._vector, self._force)
        return self._vector.array_r.copy()

    def stiffness(self):
        """PETSc matrix of their derivatives [N/m]."""
        petsc_compat.assemble_matrix(self._matrix, self._stiffness, self._bcs, MU)
        return self._matrix

    def prescribed(self, time):
        """Displacements of the base [m]."""
        return np.zeros(len(self.fixed))

    def nodal_stiffness(self):
        """Scale of the contact forces [N/m]."""
        return np.full(self.num_owned, MU)


def solve(block, contact, x):
    """Newton's method for a load step, with a SNES of your own."""

    def residual(snes, x, f):
        block.at(*contact.displacements(x))
        f.array_w[:] = contact.residual(x, [block.force()])

    def jacobian(snes, x, j, p):
        block.at(*contact.displacements(x))
        contact.jacobian(x, [block.stiffness()])

    snes, f = PETSc.SNES().create(block.comm), x.duplicate()
    snes.setFunction(residual, f)
    snes.setJacobian(jacobian, contact.jacobian(x, [block.stiffness()]))
    snes.getKSP().setType("preonly")
    snes.getKSP().getPC().setType("lu")
    snes.getKSP().getPC().setFactorSolverType("mumps")
    snes.setTolerances(rtol=0.0, atol=1e-8 * MU, stol=0.0)
    snes.solve(None, x)
    assert snes.getConvergedReason() > 0, "Newton's method failed"
    snes.destroy()
    f.destroy()


def mesh_of(comm, cells):
    """Hexahedra."""
    ends = [np.zeros(3), np.array([1.0, 1.0, HEIGHT])]
    n = [2 * cells, 2 * cells, cells]
    return create_box(comm, ends, n, CellType.hexahedron, ghost_mode=GhostMode.shared_facet)


def by_hand(comm, cells, steps, progress):
    """Contact force [N] and number of nodes in contact after each load step."""
    block = Block(mesh_of(comm, cells))
    top = block.boundary()
    contact, rows = nts.ContactTerms([block], [nts.ContactPair(top, ball())]), []
    for k in tqdm(range(steps), unit="step", disable=not (progress and comm.rank == 0)):
        x = contact.begin((k + 1) / steps, reach=2 * DEPTH / steps)
        solve(block, contact, x)
        contact.accept(x)
        (force,), (last,) = contact.forces(x), contact.state.contacts
        local = np.array([force[2::3].sum(), np.count_nonzero(last.force)])
        rows.append(comm.allreduce(local))
    contact.destroy()
    return np.array(rows)


def by_package(comm, cells, steps, output):
    """The same of `nts.equilibrium`."""

    def neo_hooke(c):
        log = ufl.ln(ufl.det(c))
        return 0.5 * MU * (ufl.tr(c) - 3 - log) + LAMBDA / 8 * log**2

    base = nts.Dirichlet(lambda x: x[2] < 1e-9)
    mesh = mesh_of(comm, cells)
    block = nts.Continuum(mesh, neo_hooke, density=1.0, bcs=[base], name="block")
    top = block.boundary()
    system = nts.System([block], contacts=[nts.ContactPair(top, ball())])
    writers = [Fields(output)] if output else []
    run = nts.equilibrium(system, load_steps=steps, output=writers)
    if output:
        picture([block], Path(output) / "own_problem.png", colour="stress")
    return np.column_stack([run.contact_forces[1:, 0, 2], run.balance["active"][1:]]), run.status


def main(comm=MPI.COMM_WORLD, *, cells=4, steps=10, output=None, progress=False):
    """Contact force [N] and nodes in contact by hand and by the package, shape (steps, 2) each."""
    ours = by_hand(comm, cells, steps, progress)
    theirs, status = by_package(comm, cells, steps, output)
    if comm.rank == 0:
        print(f"contact force {-ours[-1, 0]:.6g} N by hand, {-theirs[-1, 0]:.6g} N by equilibrium")
    return {"by_hand": ours, "by_package": theirs, "status": status}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/own_problem", help="picture and fields")
    parser.add_argument("--cells", type=int, default=4)
    parser.add_argument("--steps", type=int, default=10)
    main(progress=True, **vars(parser.parse_args()))
