"""A heavy top precesses, and nods when it is let go: the conserving scheme against exact motion.

Problem. A cone of height 0.1, radius 0.05 and density 2700 turns about its tip, which a ball joint
holds to the ground; g = 9.81. Its axis leans by 60 degrees. With precession Omega, moments I about
the axis and K across it through the tip, centre at the distance s, the axis keeps its angle a if
the spin about it is

    w = (m g s + K Omega^2 cos a) / (I Omega),

140.6 rad/s at Omega = 10 rad/s: steady precession. Let go with the same spin but without
precession the top falls, turns aside and rises to where it began: it nods.

Reference. Steady precession is known; the nodding top is solved by SciPy to 1e-12 in the variables
L (angular momentum about the tip) and R (directors), L' = s x m g, R' = omega x R.

What to see. The energy-momentum scheme errs by order 2: 5.9e-3, 1.5e-3 and 3.7e-4 of the centre's
distance after 0.5 s with steps of 4, 2 and 1 ms, in which the top spins by 32, 16 and 8 degrees. It
keeps the energy and the vertical angular momentum to round-off whatever the step, so the wrong
motion is still that of a top: it nods a little about its circle, by as much as it errs. The meshed
cone, made for pictures and fields, lacks what its flat facets cut off; its spin follows from its
own mass and moments, and it precesses like the other.

    mpirun -n 2 python demos/heavy_top.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

HEIGHT, RADIUS, DENSITY, GRAVITY = 0.1, 0.05, 2700.0, 9.81
LEAN, PRECESSION = np.pi / 3, 10.0
#: Columns: the principal axes at the start, the cone's own last.
AXES = np.array([
    [np.cos(LEAN), 0.0, np.sin(LEAN)], [0.0, 1.0, 0.0], [-np.sin(LEAN), 0.0, np.cos(LEAN)]
])  # fmt: skip
MASS = DENSITY * np.pi * RADIUS**2 * HEIGHT / 3
#: Distance of the centre from the tip, moments about the centre, across and about the axis.
FAR, ABOUT = 0.75 * HEIGHT, 0.3 * MASS * RADIUS**2
ACROSS = MASS * (3 / 20 * RADIUS**2 + 3 / 80 * HEIGHT**2)


def spin_of(mass, far, across, about):
    """Angular velocity about the axis of steady precession [rad/s]; moments about the centre."""
    tip = across + mass * far**2
    return (mass * GRAVITY * far + tip * PRECESSION**2 * np.cos(LEAN)) / (about * PRECESSION)


def turning(spin, precession):
    """Angular velocity in space, shape (3,), from that about the axis and the precession."""
    axis = AXES[:, 2]
    return precession * (np.array([0.0, 0.0, 1.0]) - np.cos(LEAN) * axis) + spin * axis


def steady(t):
    """Direction of the axis in steady precession, shape (..., 3)."""
    angle = PRECESSION * np.asarray(t)
    level = np.sin(LEAN) * np.array([np.cos(angle), np.sin(angle)])
    return np.stack([*level, np.full_like(angle, np.cos(LEAN))], axis=-1)


def nodding(t):
    """Direction of the axis of the top let go without precession at times t, shape (n, 3)."""
    tip = ACROSS + MASS * FAR**2
    moments = np.array([tip, tip, ABOUT])
    spin = turning(spin_of(MASS, FAR, ACROSS, ABOUT), 0.0)

    def rates(_, state):
        directors, momentum = state[:9].reshape(3, 3), state[9:]
        omega = directors @ ((directors.T @ momentum) / moments)
        pull = np.cross(FAR * directors[:, 2], [0.0, 0.0, -MASS * GRAVITY])
        return np.concatenate([np.cross(omega, directors, axisb=0, axisc=0).ravel(), pull])

    start = np.concatenate([AXES.ravel(), AXES @ (moments * (AXES.T @ spin))])
    found = solve_ivp(rates, (0.0, t[-1]), start, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t)
    return found.y[:9].T.reshape(-1, 3, 3)[:, :, 2]


def cone_mesh(comm, size):
    """Tetrahedra of this size [m], tip at the origin, leaning; meshed by Gmsh on rank 0."""
    import gmsh  # on all ranks, so that all fail where it is missing

    model = None
    if comm.rank == 0:
        gmsh.initialize()
        gmsh.option.setNumber("General.Verbosity", 2)
        model = gmsh.model
        cone = model.occ.addCone(0, 0, 0, 0, 0, HEIGHT, 0, RADIUS)
        model.occ.synchronize()
        model.setPhysicalName(3, model.addPhysicalGroup(3, [cone]), "cone")
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        model.mesh.generate(3)
    mesh = nts.bodies_from_gmsh(model, comm)["cone"].mesh
    if comm.rank == 0:
        gmsh.finalize()
    mesh.geometry.x[:] = mesh.geometry.x @ AXES.T
    return mesh


def scene(comm, *, precession, mesh=None):
    """The top on its ball joint, from its moments in closed form or from a mesh."""
    if mesh is None:
        omega = turning(spin_of(MASS, FAR, ACROSS, ABOUT), precession)
        top = nts.RigidBody.from_inertia(
            MASS, (ACROSS, ACROSS, ABOUT), FAR * AXES[:, 2], AXES, name="top", comm=comm,
            velocity=np.cross(omega, FAR * AXES[:, 2]), angular_velocity=omega,
        )  # fmt: skip
    else:
        still = nts.RigidBody(mesh, density=DENSITY)
        # About its centre all moments of this cone are equal: no principal axis is the cone's own.
        about = still.moments @ (still.rotation.T @ AXES[:, 2]) ** 2
        across, far = 0.5 * (still.moments.sum() - about), np.linalg.norm(still.centre)
        omega = turning(spin_of(still.mass, far, across, about), precession)
        top = nts.RigidBody(
            mesh, density=DENSITY, velocity=np.cross(omega, still.centre), angular_velocity=omega,
            name="top",
        )  # fmt: skip
    tip = nts.Spherical(top, None, point=(0, 0, 0), name="tip")
    return nts.System([top], joints=[tip], gravity=(0, 0, -GRAVITY))


class Recorder:
    """A writer that keeps the direction from the tip to the centre, the same on all ranks."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.rows = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        place = stepper.system.bodies[0].position
        self.rows.append((stepper.state.time, *place))

    def close(self, stepper):
        """Make columns of the rows."""
        table = np.array(self.rows)
        self.time, self.height = table[:, 0], table[:, 3]
        self.axis = table[:, 1:] / np.linalg.norm(table[:, 1:], axis=1)[:, None]


def figures(run, path, right):
    """The run against the exact direction of the axis (n, 3): error over the centre's distance."""
    b, top = run.balance, run.system.bodies[0]
    energy = b["kinetic"] + top.mass * GRAVITY * path.height
    upright = b["angular_momentum"][:, 2]
    wrong = np.linalg.norm(path.axis - right, axis=1)
    return {
        "error": float(wrong[-1]),
        "nods": float(np.abs(path.axis[:, 2] - right[:, 2]).max()),
        "energy": float(np.ptp(energy) / energy[0]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / b["energy"][0]),
        "spin": float(np.ptp(upright) / np.abs(upright[0])),
        "mass": top.mass,
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "status": run.status,
        "history": {"time": path.time, "axis": path.axis},
    }


def orders(results):
    """Observed orders between one step and the next [-]."""
    steps = list(results)
    pairs = zip(steps[:-1], steps[1:], strict=True)
    return [
        float(np.log(results[a]["error"] / results[b]["error"]) / np.log(a / b)) for a, b in pairs
    ]


def plot(results, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, (above, order) = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
    for colour, (motion, runs) in zip(("C0", "C1"), results.items(), strict=False):
        if motion == "meshed":
            continue
        best = runs[min(runs)]["history"]
        exact = EXACT[motion](best["time"])
        above.plot(exact[:, 0], exact[:, 1], "k:", lw=3, alpha=0.4)
        above.plot(*best["axis"][:, :2].T, color=colour, lw=1, label=motion)
        order.loglog(list(runs), [r["error"] for r in runs.values()], "o-", color=colour,
                     label=motion)  # fmt: skip
    above.set(xlabel="x [-]", ylabel="y [-]", aspect="equal",
              title="the axis from above; dotted: exact")  # fmt: skip
    above.legend()
    order.set(xlabel="step [s]", ylabel="error of the axis at the end [-]")
    order.legend()
    figure.savefig(folder / "heavy_top.png", dpi=150)
    plt.close(figure)


EXACT = {"steady": steady, "nodding": nodding}
PRECESSIONS = {"steady": PRECESSION, "nodding": 0.0}


def report(results):
    print(f"{'motion':10}{'step [s]':>10}{'error':>12}{'energy':>10}{'spin':>10}{'seconds':>9}")
    for motion, runs in results.items():
        for dt, r in runs.items():
            print(f"{motion:10}{dt:>10.3g}{r['error']:>12.4g}{r['energy']:>10.1e}"
                  f"{r['spin']:>10.1e}{r['seconds']:>9.1f}")  # fmt: skip
        if motion != "meshed":
            print(f"{motion:10}of order {', '.join(f'{p:.3f}' for p in orders(runs))}")


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    steps=(4e-3, 2e-3, 1e-3),
    t_end=0.5,
    size=0.012,
    progress=False,
):
    """Let the top precess and nod, with the steps given; with `output` a meshed one, too.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        steps: Steps [s].
        t_end: [s].
        size: Of the tetrahedra of the meshed cone [m].
        progress: Show a progress line.

    Returns:
        {motion: {step: figures}} of "steady" and "nodding", and of "meshed" with `output`; see
        `figures`.
    """

    def run(system, dt, right, writers=()):
        path, clock = Recorder(), time.perf_counter()
        done = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=t_end,
                            output=[path, *writers], progress=progress)  # fmt: skip
        return figures(done, path, right(path.time)) | {"seconds": time.perf_counter() - clock}

    results = {
        motion: {dt: run(scene(comm, precession=speed), dt, EXACT[motion]) for dt in steps}
        for motion, speed in PRECESSIONS.items()
    }
    if output is not None:
        folder, dt = Path(output), steps[len(steps) // 2]
        system = scene(comm, precession=PRECESSION, mesh=cone_mesh(comm, size))
        film = Film(folder / "film.gif", interval=max(t_end / 50, dt), view=(8.0, 20.0))
        writers = [Fields(folder, interval=max(t_end / 50, dt)), film]
        results["meshed"] = {dt: run(system, dt, steady, writers)}
        picture(system, folder / "top.png", title=f"t = {t_end:g} s", view=(8.0, 20.0))
        if comm.rank == 0:
            plot(results, folder)
    if comm.rank == 0:
        report(results)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/heavy_top", help="pictures and fields")
    parser.add_argument("--steps", type=float, nargs="+", default=[4e-3, 2e-3, 1e-3], help="[s]")
    parser.add_argument("--t-end", type=float, default=0.5, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
