"""Hertz contact: the pressure between cylinders and between spheres against the closed forms.

Problems. Two neo-Hookean half cylinders or half spheres, flat faces outwards, touch at a point of
their round sides and are pressed together. `partial_slip.py` shears the cylinders afterwards.
- cylinders: R = 8, E = 200, nu = 0.3, plane strain; a pressure of 0.625 on the upper flat face,
  that is P = 10 per length.
- spheres: D = 12.2474, nu = 0.29, E = 1e6 of the upper and 1e8 of the lower one, F = 117808.79.

Reference (Johnson 1985). With 1/R* the sum of both 1/R and 1/E* that of both (1 - nu^2)/E, the
pressure is p0 sqrt(1 - x^2/a^2): between cylinders a^2 = 4 P R*/(pi E*), p0 = 2 P/(pi a); between
spheres a^3 = 3 F R*/(4 E*), p0 = 3 F/(2 pi a^2).

Method. A structured mesh (meshes/half_round.py) is fine under the contact and grows from there.
The bodies are mirror images, so that nodes meet nodes: one-pass node-to-surface contact fails the
patch test on meshes that do not match, and its nodal pressures scatter there. Symmetry saves half
of the cylinders and three quarters of the spheres; cylinders are one cell long and held at both
ends. Pressures are nodal forces over tributary areas, on the undeformed surface, as the linear
theory has it. The figures come from them without the closed form:
- p0 is the largest nodal pressure;
- a follows from the second moment of the contact forces: the mean of x^2 is a^2/4 for cylinders
  and 2 a^2/5 for spheres.

What to see. As prescribed (scale 1), p0/E is 5 % for the cylinders and 14 % for the spheres:
strains that the linear theory leaves out. p0 misses it by 1 % and 4 %, on any mesh. Under loads
that make a and the strains a hundredth (scale 0.01), a and p0 are within 0.6 % of the closed form
on these meshes; half as many cells (`--refinement 0.5`) give 2 to 5 %.

    mpirun -n 2 python demos/hertz.py
"""

import argparse
import runpy
import time
from dataclasses import dataclass, replace
from pathlib import Path

from mpi4py import MPI

import numpy as np

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh
from dolfinx_nts.output import Fields
from dolfinx_nts.output.pictures import picture

MESHES = runpy.run_path(str(Path(__file__).resolve().parents[1] / "meshes" / "half_round.py"))
#: Size of the finely meshed block over the half-width of contact.
BLOCK = 1.3
#: Of the closed forms and of the nodes, for each curve of a problem.
LINES, MARKERS = ("-", "--"), ("ox", "s+")


@dataclass(frozen=True)
class Problem:
    """Two bodies of equal radius, and their closed form.

    Attributes:
        radius: Of both [m].
        young: Of the upper and the lower one [Pa]; nodes of the upper, softer one are slaves.
        poisson: Of both.
        force: What presses them together [N], of cylinders per length [N/m].
        cells: From the middle of the contact to the side of the finely meshed block.
        spheres: Or cylinders.
    """

    radius: float
    young: tuple[float, float]
    poisson: float
    force: float
    cells: int
    spheres: bool = False

    def scaled(self, scale):
        """Return the same under a load that makes contact and strains `scale` times as large."""
        return replace(self, force=(scale**3 if self.spheres else scale**2) * self.force)

    @property
    def modulus(self):
        """E* [Pa]."""
        return 1 / sum((1 - self.poisson**2) / young for young in self.young)

    @property
    def half_width(self):
        """Half-width or radius of the contact [m]."""
        if self.spheres:
            return (0.375 * self.force * self.radius / self.modulus) ** (1 / 3)
        return (2 * self.force * self.radius / np.pi / self.modulus) ** 0.5

    @property
    def peak(self):
        """Largest pressure [Pa]."""
        a = self.half_width
        return 1.5 * self.force / np.pi / a**2 if self.spheres else 2 * self.force / np.pi / a

    @property
    def block(self):
        """Size of the finely meshed block [m]."""
        return BLOCK * self.half_width

    def pressure(self, x):
        """Return the pressure at a distance from the middle [Pa]."""
        return self.peak * half_ellipse(x / self.half_width)

    def curves(self):
        """Return {column of the profile: (its name, closed form, largest value)}."""
        return {"pressure": ("p / p0", self.pressure, self.peak)}


def half_ellipse(x):
    return np.sqrt(np.maximum(0.0, 1.0 - x**2))


PROBLEMS = {
    "cylinders": Problem(8.0, (200.0, 200.0), 0.3, force=16 * 0.625, cells=8),
    "spheres": Problem(12.2474 / 2, (1e6, 1e8), 0.29, force=117808.79, cells=6, spheres=True),
}


def half_round(comm, problem, *, lower, whole):
    """Mesh of one body; the lower one is the mirror image of the upper one."""
    points, cells = np.empty((0, 3)), np.empty((0, 8), np.int64)
    if comm.rank == 0:
        n, size = problem.cells, (problem.radius, problem.block)
        if problem.spheres:
            cells, points = MESHES["half_sphere"](n, *size)
        else:
            cells, points = MESHES["half_cylinder"](n, *size, whole=whole)
        if lower:
            points[:, 2] *= -1
            cells = np.roll(cells, 4, axis=1)
    return create_mesh(comm, cells, points, "hexahedron")


def plane(problem, axis, value):
    """Marker of a plane across an axis."""
    return lambda x: np.abs(x[axis] - value) < 1e-9 * problem.radius


def scene(
    comm, problem, *, held=(), loads=(), whole=False, friction=0.0, integration="nodes"
):
    """Both bodies; `held` and `loads` are conditions and tractions of the upper one.

    `whole` cylinders instead of the half x >= 0; `integration` as of `ContactPair`.
    """
    r, block = problem.radius, problem.block
    sides = [] if whole else [nts.Dirichlet(plane(problem, 0, 0.0), components=(0,))]
    for y in (0.0,) if problem.spheres else (0.0, block / problem.cells):
        sides.append(nts.Dirichlet(plane(problem, 1, y), components=(1,)))
    foot = nts.Dirichlet(plane(problem, 2, -r), components=(0, 2))

    def body(name, young, *, lower, bcs, traction=()):
        mesh = half_round(comm, problem, lower=lower, whole=whole)
        material = nts.NeoHookean(young, problem.poisson)
        bcs = [*sides, *bcs]
        return nts.Continuum(mesh, material, density=1.0, bcs=bcs, traction=traction, name=name)

    def under_the_block(centre):
        across = 1 if problem.spheres else 0

        def marker(x):
            square = x[0] ** 2 + across * x[1] ** 2
            on_surface = np.abs(np.sqrt(square + (x[2] - centre) ** 2) - r) < 1e-9 * r
            near = np.maximum(np.abs(x[0]), across * np.abs(x[1])) < 1.001 * block
            return on_surface & near

        return marker

    upper = body("upper", problem.young[0], lower=False, bcs=held, traction=loads)
    lower = body("lower", problem.young[1], lower=True, bcs=[foot])
    pair = nts.ContactPair(
        slave=upper.surface(under_the_block(r)),
        master=lower.surface(under_the_block(-r)),
        friction=friction,
        integration=integration,
    )
    return nts.System([upper, lower], contacts=[pair])


def pressed(comm, problem, **options):
    """Return both bodies under an even pressure on the flat face."""
    r, n = problem.radius, problem.cells
    rim = np.sin(np.diff(np.arctan(np.arange(n + 1) / n)))  # the face of a sphere is a polygon
    area = 4 * r**2 * rim.sum() if problem.spheres else 2 * r
    load = nts.Traction(plane(problem, 2, r), (0.0, 0.0, -problem.force / area))
    return scene(comm, problem, loads=[load], **options)


def press(comm, problem, **options):
    """Return their equilibrium; options of `equilibrium`."""
    return nts.equilibrium(pressed(comm, problem), load_steps=2, **options)


def pressing_force(problem, run, *, parts):
    """Contact force of each load step [N] or [N/m]; the model is one of so many equal parts."""
    length = 1.0 if problem.spheres else problem.block / problem.cells
    return parts * run.contact_forces[:, 0, 2] / length


def nodes_in_contact(problem, run):
    """x, y [m], tributary area [m^2], normal and tangential force [N], the same on all ranks.

    Friction counts against the direction of the shear. Cylinders: those of one end.
    """
    state, slave = run.state, run.system.contacts[0].slave
    x, area = slave.reference[slave.share], slave.area[slave.share]
    contact = state.contacts[0]
    rows = np.column_stack([x[:, :2], area, contact.force, -contact.tangential[:, 0]])
    rows = np.concatenate(run.system.comm.allgather(rows))
    if not problem.spheres:
        rows = rows[np.abs(rows[:, 1]) < 1e-9 * problem.radius]
    rows = rows[rows[:, 3] > 0.0]
    return rows[np.lexsort(rows[:, 1::-1].T)].T


def half_width(problem, x, force):
    """Half-width [m] of a pressure of Hertz with the second moment of these forces."""
    return np.sqrt((2.5 if problem.spheres else 4.0) * (force * x**2).sum() / force.sum())


def difference(area, values, exact):
    """Root of the mean square over that of the exact values."""
    return float(np.sqrt((area * (values - exact) ** 2).sum() / (area * exact**2).sum()))


def figures(problem, run):
    """Return what is to be compared, beside the closed form, and the profile of the pressure."""
    x, y, area, normal, _ = nodes_in_contact(problem, run)
    distance = np.hypot(x, y) if problem.spheres else np.abs(x)
    pressure = normal / area
    force = pressing_force(problem, run, parts=4 if problem.spheres else 2)[-1]
    table = {
        "force": (force, problem.force),
        "a": (half_width(problem, distance, normal), problem.half_width),
        "p0": (pressure.max(), problem.peak),
    }
    columns = {
        "position": distance,
        "pressure": pressure,
        "exact_pressure": problem.pressure(distance),
    }
    return summary(problem, run, table, columns, area)


def summary(problem, run, table, columns, area):
    """Return the figures of a run, the same on all ranks.

    Args:
        problem: The problem.
        run: Its equilibrium.
        table: {figure: (computed, exact)}.
        columns: Of the profile: "position", and each curve of the problem beside its "exact_" one.
        area: Tributary areas of the nodes in contact [m^2], shape (n,).
    """
    return {
        "computed": {name: float(values[0]) for name, values in table.items()},
        "exact": {name: float(values[1]) for name, values in table.items()},
        "error": {name: float(values[0] / values[1] - 1) for name, values in table.items()},
        "difference": {
            n: difference(area, columns[n], columns["exact_" + n]) for n in problem.curves()
        },
        "profile": columns,
        "status": run.status,
        "load_steps": len(run.rows) - 1,
        "newton_iterations": int(run.balance["newton_iterations"].sum()),
        "retries": run.retries,
    }


def report(problem, name, scale, result):
    print(
        f"{name}, {problem.cells} cells, scale {scale:g}: {result['status']}, "
        f"{result['load_steps']} load steps, {result['newton_iterations']} iterations, "
        f"{result['retries']} retries, {result['seconds']:.1f} s"
    )
    for key, error in result["error"].items():
        exact, computed = result["exact"][key], result["computed"][key]
        print(f"  {key:10}{exact:14.7g}{computed:14.7g}{error:+10.2%}")
    for key, value in result["difference"].items():
        print(f"  {key} of the nodes, root mean square difference {value:.2%}")


def write(problems, results, path, *, start=0.0):
    """Write a CSV file of each profile, and a picture of all, in units of the closed form.

    Args:
        problems: {name: problem}.
        results: {name: {scale: figures}}.
        path: The picture; the tables go beside it.
        start: Where the closed forms start, over the half-width.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    size = (7, 3 * len(results))
    figure, axes = plt.subplots(len(results), figsize=size, layout="constrained", squeeze=False)
    for (name, runs), axis in zip(results.items(), axes[:, 0], strict=True):
        problem, x = problems[name], np.linspace(start, 1.0, 1001)
        for (label, curve, peak), look in zip(problem.curves().values(), LINES, strict=False):
            y = curve(x * problem.half_width) / peak
            axis.plot(x, y, look, color="k", lw=1, label=f"{label}, closed form")
        for number, (scale, result) in enumerate(runs.items()):
            table = result["profile"]
            columns = np.column_stack(list(table.values()))
            file = path.parent / f"{name}_{scale:g}.csv"
            np.savetxt(file, columns, delimiter=",", header=",".join(table), comments="")
            scaled = problem.scaled(scale)
            at = table["position"] / scaled.half_width
            look = {"color": f"C{number}", "mfc": "none", "ls": "none"}
            for (column, (label, _, peak)), signs in zip(
                scaled.curves().items(), MARKERS, strict=False
            ):
                y, sign = table[column] / peak, signs[number % 2]
                axis.plot(at, y, marker=sign, label=f"{label}, scale {scale:g}", **look)
        axis.set(title=name, xlabel="x / a", ylabel="traction over its closed-form peak")
        axis.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=150)
    plt.close(figure)


def at_each_scale(name, problem, solve, figures, *, comm, output, scales, refinement, progress):
    """Return {scale: figures} of a problem, and leave a picture and fields of each run.

    Args:
        name: Name of the problem.
        problem: The problem as prescribed.
        solve: Function (comm, problem, output=, progress=) that returns the equilibrium.
        figures: Function (problem, run).
        comm: MPI communicator.
        output: Folder, or None.
        scales: Sizes of contact and strains over those of the problem as prescribed.
        refinement: Cells across the contact over those of the demo's mesh.
        progress: Show a progress line.
    """
    results = {}
    for scale in scales:
        clock = time.perf_counter()
        at = replace(problem.scaled(scale), cells=round(refinement * problem.cells))
        folder = output and Path(output) / f"{name}_{scale:g}"
        run = solve(comm, at, output=[Fields(folder)] if folder else [], progress=progress)
        if folder:
            picture(run, folder / "stress.png", colour="stress", view=(10.0, -75.0))
        results[scale] = figures(at, run)
        results[scale]["seconds"] = time.perf_counter() - clock
        if comm.rank == 0:
            report(at, name, scale, results[scale])
    return results


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    problems=tuple(PROBLEMS),
    scales=(1.0, 0.01),
    refinement=1.0,
    progress=False,
):
    """Press cylinders and spheres together.

    Args:
        comm: MPI communicator.
        output: Folder for profiles (CSV), pictures and fields, or None.
        problems: Which of "cylinders", "spheres".
        scales: Sizes of contact and strains over those of the problem as prescribed.
        refinement: Cells across the contact over those of the demo's mesh.
        progress: Show a progress line.

    Returns:
        {problem: {scale: figures}}; see `figures`.
    """
    options = {"comm": comm, "output": output, "scales": scales, "refinement": refinement}
    results = {
        name: at_each_scale(name, PROBLEMS[name], press, figures, progress=progress, **options)
        for name in problems
    }
    if output is not None and comm.rank == 0:
        write(PROBLEMS, results, Path(output) / "hertz.png")
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/hertz", help="profiles, pictures and fields")
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=tuple(PROBLEMS))
    parser.add_argument("--scales", nargs="+", type=float, default=(1.0, 0.01))
    parser.add_argument("--refinement", type=float, default=1.0)
    main(progress=True, **vars(parser.parse_args()))
