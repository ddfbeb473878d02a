"""Two cubes that collide, with this package and with MuJoCo and NGSolve: time per step, energy.

    python benchmarks/peers.py
    python benchmarks/peers.py --cells 16 --packages dolfinx_nts MuJoCo

The scene is that of step_time.py: cubes of n^3 and (n + 1)^3 hexahedra, 100 steps of 1 ms, on one
core. A package that is not installed is left out (`pip install mujoco ngsolve` in a venv that sees
DOLFINx and keeps its numpy). Printed are the median processor time of a step in contact (the second
cube's momentum changes) and in flight, how much the total energy changes over the run, and the
momentum of the second cube in the end. What differs:

dolfinx_nts: neo-Hookean, node-to-surface contact without penalty, energy-momentum scheme, accuracy
"balanced", which keeps a factorised matrix while it serves; energy is lost where a gap closes.

NGSolve: the same material and hexahedra, implicit midpoint rule, a penalty of 10 E n [Pa/m] at the
Gauss points of one surface. Its own Newton method factorises in each iteration and stops at a
similar accuracy. Forms are compiled where its script ngscxx is found, and interpreted elsewhere.

MuJoCo: six St. Venant-Kirchhoff tetrahedra for each hexahedron, mass lumped by volume, and contact
that is soft, here critically damped with a time constant of two steps and nearly rigid (impedance
0.99 to 0.9999). Its integrator for elasticity, `discrete`, is one linearised step of the implicit
Euler rule: the least work, and it damps all that moves fast. Its solver CG keeps the momentum to
0.1 % only; Newton, its default, keeps it, and takes 145 in place of 32 ms at 8^3 cells. It knows no
elastic energy of flexes, which is computed here from their vertices.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

from mpi4py import MPI

import numpy as np
from step_time import cubes

import dolfinx_nts as nts
from dolfinx_nts.solve.accuracy import ACCURACY

_STEP, _GAP, _DENSITY = 1e-3, 0.05, 1e3
_YOUNG, _POISSON = 1e6, 0.3
_MU = _YOUNG / (2 * (1 + _POISSON))
_LAMBDA = _YOUNG * _POISSON / ((1 + _POISSON) * (1 - 2 * _POISSON))


class Own:
    """The scene with this package."""

    def __init__(self, n: int) -> None:
        system = cubes(MPI.COMM_SELF, n, _GAP)
        self.right = system.bodies[1]
        self.stepper = nts.Stepper(system, nts.EnergyMomentum(), newton=ACCURACY["balanced"])

    def advance(self) -> None:
        self.stepper.advance(_STEP)

    def energy(self) -> float:
        return float(self.stepper.solution.balance["energy"][-1])

    def momentum(self) -> float:
        return nts.motion_of(self.right).velocity[0] * _DENSITY


def joined(n: int) -> Any:
    """Both cubes in one mesh of NGSolve: regions cube0 and cube1, sides back0, front0, ..."""
    from netgen.meshing import Element2D, Element3D, FaceDescriptor, Mesh
    from ngsolve import Mesh as Finished
    from ngsolve.meshes import MakeStructured3DMesh as Box

    whole = Mesh()
    whole.dim = 3
    parts = Box(nx=n), Box(nx=n + 1, mapping=lambda x, y, z: (x + 1 + _GAP, y, z))
    for k, part in enumerate(parts):
        points = [whole.Add(point) for point in part.ngmesh.Points()]
        whole.SetMaterial(k + 1, f"cube{k}")
        faces = []
        for side, name in enumerate(part.GetBoundaries(), 6 * k):
            faces += [whole.Add(FaceDescriptor(surfnr=side + 1, domin=k + 1, bc=side + 1))]
            whole.SetBCName(side, f"{name}{k}")
        for cell in part.ngmesh.Elements3D():
            whole.Add(Element3D(k + 1, [points[v.nr - 1] for v in cell.vertices]))
        for facet in part.ngmesh.Elements2D():
            face = faces[facet.index - 1]
            whole.Add(Element2D(face, [points[v.nr - 1] for v in facet.vertices]))
    return Finished(whole)


class NGSolve:
    """The scene with NGSolve; the unknown is the displacement in the middle of the step."""

    def __init__(self, n: int) -> None:
        import ngsolve as ng

        ng.SetNumThreads(1)
        self.ng, self.mesh = ng, joined(n)
        space = ng.VectorH1(self.mesh, order=1)
        fields = [ng.GridFunction(space) for _ in range(4)]
        self.u, self.v, self.middle, self.guess = fields
        throw = ng.CF((2 + 0.5 * (ng.z - 0.5), 0, -0.5 * (ng.x - 0.5)))
        self.v.Set(throw, definedon=self.mesh.Materials("cube0"))
        self.values = [field.vec.FV().NumPy() for field in fields]
        trial, test = space.TnT()
        compiled = {"realcompile": shutil.which("ngscxx") is not None, "wait": True}
        self.form = ng.BilinearForm(space, symmetric=True)
        self.form += ng.Variation(self._elastic(ng.Grad(trial)).Compile(**compiled) * ng.dx)
        self.form += 4 * _DENSITY / _STEP**2 * ng.InnerProduct(trial - self.guess, test) * ng.dx
        faces = [self.mesh.Boundaries(name) for name in ("front0", "back1")]
        self.contact = ng.ContactBoundary(*faces)
        place = ng.CF((ng.x, ng.y, ng.z))
        depth = (place + trial - place.Other() - trial.Other()) * self.contact.normal
        penalty = ng.IfPos(depth, 10 * _YOUNG * n / 2 * depth**2, 0)
        self.contact.AddEnergy(penalty.Compile(**compiled))

    def _elastic(self, gradient: Any) -> Any:
        """Neo-Hookean energy density."""
        f = self.ng.Id(3) + gradient
        log = self.ng.log(self.ng.Det(f))
        return _MU / 2 * (self.ng.InnerProduct(f, f) - 3 - 2 * log) + _LAMBDA / 2 * log**2

    def advance(self) -> None:
        u, v, middle, guess = self.values
        guess[:] = middle[:] = u + _STEP / 2 * v
        self.contact.Update(self.middle, self.form, intorder=2, maxdist=2 * _GAP)
        settings = {"maxerr": 1e-8, "inverse": "sparsecholesky", "printing": False}
        status, _ = self.ng.solvers.Newton(self.form, self.middle, **settings)
        if status:
            raise RuntimeError("Newton's method of NGSolve did not converge")
        v[:] = 4 / _STEP * (middle - u) - v
        u[:] = 2 * middle - u

    def energy(self) -> float:
        kinetic = _DENSITY / 2 * self.ng.InnerProduct(self.v, self.v)
        return self.ng.Integrate(kinetic + self._elastic(self.ng.Grad(self.u)), self.mesh)

    def momentum(self) -> float:
        return self.ng.Integrate(_DENSITY * self.v[0], self.mesh.Materials("cube1"))


def _flex(n: int, x: float) -> str:
    """A cube of MuJoCo. Without any damping [s] its compiler warns that there is no force."""
    return (
        f'<flexcomp name="cube{n}" type="grid" dim="3" count="{n + 1} {n + 1} {n + 1}" '
        f'spacing="{1 / n} {1 / n} {1 / n}" pos="{x} 0.5 0.5" radius="1e-4" mass="{_DENSITY}">'
        f'<elasticity young="{_YOUNG}" poisson="{_POISSON}" damping="1e-12"/>'
        f'<contact selfcollide="none" condim="1" solref="{2 * _STEP} 1" solimp="0.99 0.9999"/>'
        "</flexcomp>"
    )


def _masses(n: int) -> np.ndarray:
    """Of a cube's vertices; MuJoCo's own are the same for all."""
    width = np.full(n + 1, 1 / n)
    width[[0, -1]] /= 2
    return _DENSITY * np.einsum("i,j,k->ijk", width, width, width).ravel()


class MuJoCo:
    """The scene with MuJoCo."""

    def __init__(self, n: int) -> None:
        import mujoco

        self.engine = mujoco
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{_STEP}" gravity="0 0 0" integrator="discrete" '
            'solver="CG" iterations="1000"/>'
            f"<worldbody>{_flex(n, 0.5)}{_flex(n + 1, 1.5 + _GAP)}</worldbody></mujoco>"
        )
        self.data, self.first = mujoco.MjData(self.model), (n + 1) ** 3
        self.mass = np.concatenate([_masses(n), _masses(n + 1)])
        self.model.body_mass[self.model.flex_vertbodyid] = self.mass
        mujoco.mj_setConst(self.model, self.data)
        self.engine.mj_forward(self.model, self.data)
        self.velocity = self.data.qvel.reshape(-1, 3)
        arm = self.data.flexvert_xpos[: self.first] - 0.5
        self.velocity[: self.first, 0] = 2 + 0.5 * arm[:, 2]
        self.velocity[: self.first, 2] = -0.5 * arm[:, 0]
        start = np.repeat(self.model.flex_vertadr, self.model.flex_elemnum)
        self.cells = self.model.flex_elem.reshape(-1, 4) + start[:, None]
        self.reference = np.linalg.inv(self._edges())
        self.volume = 1 / np.abs(6 * np.linalg.det(self.reference))

    def _edges(self) -> np.ndarray:
        corners = self.data.flexvert_xpos[self.cells]
        return (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)

    def advance(self) -> None:
        self.engine.mj_step(self.model, self.data)

    def energy(self) -> float:
        self.engine.mj_forward(self.model, self.data)
        f = self._edges() @ self.reference
        strain = (f.transpose(0, 2, 1) @ f - np.eye(3)) / 2
        trace = np.trace(strain, axis1=1, axis2=2)
        density = _LAMBDA / 2 * trace**2 + _MU * (strain**2).sum(axis=(1, 2))
        kinetic = 0.5 * self.mass @ (self.velocity**2).sum(axis=1)
        return float(kinetic + self.volume @ density)

    def momentum(self) -> float:
        return float(self.mass[self.first :] @ self.velocity[self.first :, 0])


PACKAGES: dict[str, Any] = {"dolfinx_nts": Own, "MuJoCo": MuJoCo, "NGSolve": NGSolve}


def measure(name: str, n: int, steps: int) -> None:
    """Run and print."""
    scene = PACKAGES[name](n)
    start, seconds, momentum = scene.energy(), np.zeros(steps), [scene.momentum()]
    for k in range(steps):
        begin = time.process_time()
        scene.advance()
        seconds[k] = time.process_time() - begin
        momentum.append(scene.momentum())
    touching = np.abs(np.diff(momentum)) > 2e-3
    contact, flight = 1e3 * np.median(seconds[touching]), 1e3 * np.median(seconds[~touching])
    print(
        f"n = {n}, {name} {version(name.lower())}: {contact:.2f} ms a step in contact "
        f"({touching.sum()} steps), {flight:.2f} in flight; energy "
        f"{100 * (scene.energy() / start - 1):+.2f} %; {momentum[-1]:.0f} of 2000 kg m/s passed on",
        flush=True,
    )


def main() -> None:
    """Print a line for each package and mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[4, 8])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--packages", nargs="+", default=list(PACKAGES), choices=list(PACKAGES))
    options = parser.parse_args()
    # Where pip puts ngscxx.
    os.environ["PATH"] = os.path.dirname(sys.executable) + os.pathsep + os.environ["PATH"]
    for name in options.packages:
        if find_spec(name.lower()) is None:
            print(f"{name} is not installed: pip install {name.lower()}", flush=True)
            continue
        for n in options.cells:
            measure(name, n, options.steps)


if __name__ == "__main__":
    main()
