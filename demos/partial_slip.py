"""Cattaneo and Mindlin: sheared cylinders stick in the middle of their contact and slip at its rim.

Problem. The cylinders of `hertz.py` (R = 8, E = 200, nu = 0.3, P = 10 per length), with mu = 0.2.
Once they are pressed together, a plate holds the upper flat face level, and a traction of 0.05851
on it, Q = 0.93616 per length, shears the contact.

Reference (Johnson 1985). The pressure stays that of Hertz, p = p0 sqrt(1 - x^2/a^2). The cylinders
stick in |x| < c, c^2 = a^2 (1 - Q/(mu P)), and slip outside. The traction is mu p there; inside it
is less, by mu p0 (c/a) sqrt(1 - x^2/c^2). It is largest at c.

Method. The mesh is that of `hertz.py`, of whole cylinders. Tractions are nodal forces over
tributary areas, on the undeformed surface, as the linear theory has it. The figures come from them
without the closed form:
- a and p0 as in `hertz.py`;
- c follows from the second moment of what friction has in reserve, mu p less the traction, which is
  a pressure of Hertz on the part that sticks;
- q_max is mu times the pressure at c, between the nodes.

What to see. As prescribed (scale 1), p0/E is 5 %: strains that the linear theory leaves out. Under
loads that make a and the strains a hundredth (scale 0.01), all figures are within 0.6 % of the
closed form on this mesh. The traction converges slowest, at its kink.

Pressing takes several load steps. A node that closes its gap within a load step counts its whole
way along the facet in that step as slip, although it touches only at the end; the traction that
this leaves behind, seen at scale 1, shrinks with the step.

    mpirun -n 2 python demos/partial_slip.py
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
from hertz import (
    PROBLEMS,
    Problem,
    at_each_scale,
    half_ellipse,
    half_width,
    nodes_in_contact,
    plane,
    pressing_force,
    scene,
    summary,
    write,
)

import dolfinx_nts as nts

#: Load steps.
PRESSING, SHEARING = 8, 4


@dataclass(frozen=True)
class Sheared(Problem):
    """Cylinders that are pressed together and sheared, and their closed form.

    Attributes:
        shear: Tangential force [N/m].
        friction: Coulomb's coefficient.
    """

    shear: float = 0.0
    friction: float = 0.0

    def scaled(self, scale):
        """Return the same under loads that make contact and strains `scale` times as large."""
        return replace(super().scaled(scale), shear=scale**2 * self.shear)

    @property
    def stick(self):
        """Half-width of the part that sticks [m]."""
        return self.half_width * (1 - self.shear / self.friction / self.force) ** 0.5

    def traction(self, x):
        """Return the traction of friction at a distance from the middle [Pa]."""
        a, c = self.half_width, self.stick
        return self.friction * (self.pressure(x) - self.peak * c / a * half_ellipse(x / c))

    def curves(self):
        """Return {column of the profile: (its name, closed form, largest value)}."""
        most = self.friction * self.peak
        return super().curves() | {"traction": ("q / (mu p0)", self.traction, most)}


CYLINDERS = Sheared(**vars(PROBLEMS["cylinders"]), shear=16 * 0.05851, friction=0.2)


def depth(comm, problem, *, progress=False):
    """Return how far a plate on the flat face goes down under the force [m], without friction."""
    top = plane(problem, 2, problem.radius)
    a, per_modulus = problem.half_width, problem.force / np.pi / problem.modulus
    most = 1.2 * per_modulus * (2 * np.log(4 * problem.radius / a) - 1)
    down = nts.Dirichlet(top, value=lambda t: (0, 0, -most * t), components=(2,))
    parts = np.array([0.7, 0.8, 0.9, 1.0])
    run = nts.equilibrium(
        scene(comm, problem, held=[down]), load_steps=parts, progress=progress
    )
    force = pressing_force(problem, run, parts=2)[1:]
    return most * np.polyval(np.polyfit(force / problem.force, parts, 3), 1.0)


def press_and_shear(comm, problem, *, progress=False, **options):
    """Return the equilibrium after pressing, until t = 1, and shearing, until t = 2.

    The plate keeps the face level, which a dead load would not: it would roll off. `options` are of
    `equilibrium`.
    """
    top, deepest = plane(problem, 2, problem.radius), depth(comm, problem, progress=progress)
    down = nts.Dirichlet(top, value=lambda t: (0, 0, -deepest * min(t, 1.0)), components=(2,))
    most = problem.shear / (2 * problem.radius)
    shear = nts.Traction(top, lambda t: (most * max(t - 1.0, 0.0), 0, 0))
    steps = [*np.linspace(0, 1, PRESSING + 1)[1:], *np.linspace(1, 2, SHEARING + 1)[1:]]
    system = scene(comm, problem, held=[down], loads=[shear], whole=True, friction=problem.friction)
    return nts.equilibrium(system, load_steps=steps, progress=progress, **options)


def figures(problem, run):
    """Return what is to be compared, beside the closed form, and the profiles."""
    x, _, area, normal, tangential = nodes_in_contact(problem, run)
    x = x - (normal * x).sum() / normal.sum()
    distance, pressure, mu = np.abs(x), normal / area, problem.friction
    order, c = np.argsort(distance), half_width(problem, distance, mu * normal - tangential)
    at_c = np.interp(c**2, distance[order] ** 2, pressure[order] ** 2) ** 0.5
    table = {
        "force": (pressing_force(problem, run, parts=1)[-1], problem.force),
        "a": (half_width(problem, distance, normal), problem.half_width),
        "p0": (pressure.max(), problem.peak),
        "c": (c, problem.stick),
        "q_max": (mu * at_c, mu * problem.pressure(problem.stick)),
    }
    columns = {
        "position": x,
        "pressure": pressure,
        "exact_pressure": problem.pressure(distance),
        "traction": tangential / area,
        "exact_traction": problem.traction(distance),
    }
    return summary(problem, run, table, columns, area)


def main(
    *, comm=MPI.COMM_WORLD, output=None, scales=(1.0, 0.01), refinement=1.0, progress=False
):
    """Press the cylinders together and shear them.

    Args:
        comm: MPI communicator.
        output: Folder for profiles (CSV), pictures and fields, or None.
        scales: Sizes of contact and strains over those of the problem as prescribed.
        refinement: Cells across the contact over those of the demo's mesh.
        progress: Show a progress line.

    Returns:
        {scale: figures}; see `figures`.
    """
    options = {"comm": comm, "output": output, "scales": scales, "refinement": refinement}
    results = at_each_scale(
        "cylinders", CYLINDERS, press_and_shear, figures, progress=progress, **options
    )
    if output is not None and comm.rank == 0:
        path = Path(output) / "partial_slip.png"
        write({"cylinders": CYLINDERS}, {"cylinders": results}, path, start=-1.0)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/partial_slip", help="profiles, pictures, fields")
    parser.add_argument("--scales", nargs="+", type=float, default=(1.0, 0.01))
    parser.add_argument("--refinement", type=float, default=1.0)
    main(progress=True, **vars(parser.parse_args()))
