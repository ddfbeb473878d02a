"""A wheel is thrown along a plate without spin: sliding friction turns it until it rolls.

Problem. A cylinder of radius 1, width 0.5 and density 1000, nearly rigid (E = 1e8), stands on an
elastic layer (E = 5e6, nu = 0, 0.1 thick, held below) in equilibrium with its weight, g = 9.81.
At t = 0 it gets the speed v0 = 3 along the layer and no spin; friction 0.3. The wheel is a mesh of
hexahedra, so its rim is a polygon; the nodes of the rim are the slaves. The layer yields by a
little more than the height of the polygon's corners, which lets the wheel roll over them without
leaving the ground.

Reference. Rigid wheel, moment of inertia I, kappa = I / (m R^2) = 1/2. Sliding with the friction
mu m g slows the centre down and spins the wheel up,

    v = v0 - mu g t,    omega R = mu g t / kappa,

until both agree at t* = v0 / (mu g (1 + 1/kappa)) = v0 / (3 mu g). From then on it rolls with
v0 / (1 + kappa) = 2/3 v0, and friction has dissipated the part kappa / (1 + kappa) = 1/3 of
m v0^2 / 2. As the impulse of friction is mu times that of the contact, this holds in the mean while
the wheel bounces a little, too.

What to see. Sliding follows the straight lines, all nodes in contact slip until t* and stick
afterwards, and friction takes the third of the energy that it must. With the energy-momentum scheme
what the ledger misses is round-off.

    mpirun -n 2 python demos/rolling.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.dolfinx_compat import create_mesh
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

RADIUS, WIDTH, DENSITY, GRAVITY = 1.0, 0.5, 1e3, 9.81
SPEED, FRICTION = 3.0, 0.3
LAYER, START, END = 0.1, -0.6, 2.4
INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
SHOWN = ("slide_end", "speed", "spin", "dissipated", "energy_lost", "ledger")


def disc(facets, rings):
    """Points (n, 2) of the unit disc and cells (m, 4): a grid inside rings of quadrilaterals.

    Args:
        facets: Around the rim, a multiple of 4.
        rings: Around the square.
    """
    n = facets // 4
    s = np.linspace(-1.0, 1.0, n + 1)
    x, y = np.meshgrid(s, s, indexing="xy")
    # Sides bulge a little, so that the cells at the corners of the square have no straight angle.
    square = 0.5 * np.stack([x * (1 - 0.12 * y**2), y * (1 - 0.12 * x**2)], axis=-1)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    border = np.r_[number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]]
    quads = [
        np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], axis=-1)
    ]
    quads[0] = quads[0].reshape(-1, 4)
    points = [square.reshape(-1, 2)]
    inner = points[0][border]
    angle = -0.75 * np.pi + 2 * np.pi * np.arange(facets) / facets
    rim = np.column_stack([np.cos(angle), np.sin(angle)])
    last = border
    for k in range(rings):
        part = (k + 1) / rings
        points.append((1 - part) * inner + part * rim)
        new = (n + 1) ** 2 + k * facets + np.arange(facets)
        quads.append(np.stack([np.roll(last, -1), last, np.roll(new, -1), new], axis=-1))
        last = new
    return np.concatenate(points), np.concatenate(quads)


def wheel_mesh(comm, facets, rings):
    """One layer of hexahedra across the width, built on rank 0; the axis is y, z >= 0."""
    flat, quads = disc(facets, rings)
    # Turned by half a facet the wheel stands on one, which is the lowest it can be.
    turn = np.pi / facets * (facets // 4 % 2 == 0)
    c, s = np.cos(turn), np.sin(turn)
    flat = flat @ np.array([[c, s], [-s, c]])
    flat = RADIUS * flat + [0.0, -RADIUS * flat[:, 1].min()]
    faces = [np.insert(flat, 1, y, axis=1) for y in (WIDTH / 2, -WIDTH / 2)]
    points, cells = np.concatenate(faces), np.hstack([quads, quads + len(flat)])
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    return create_mesh(comm, cells, points, "hexahedron")


def ground_mesh(comm):
    """One layer of hexahedra, z <= 0."""
    cells = [round((END - START) / RADIUS * 12), 1, 1]
    box = [[START, -0.6 * WIDTH, -LAYER], [END, 0.6 * WIDTH, 0.0]]
    return create_box(comm, box, cells, CellType.hexahedron, ghost_mode=GhostMode.shared_facet)


def scene(mesh, ground, facets, *, settle, smoothing=False):
    """Wheel above the layer; while it settles, its hub may not move sideways.

    The meshes are those of the throw and of settling: ranks may share out another one otherwise.
    """
    centre = RADIUS * np.cos(np.pi / facets)
    cell = 4 * RADIUS / facets
    hub = nts.Dirichlet(
        lambda x: np.hypot(x[0], x[2] - centre) < 1.6 * cell,
        components=(0, 1),
    )
    wheel = nts.Continuum(
        mesh,
        nts.NeoHookean(young=1e8, poisson=0.3),
        density=DENSITY,
        velocity=(SPEED, 0.0, 0.0),
        bcs=[hub] if settle else [],
        name="wheel",
    )
    layer = nts.Continuum(
        ground,
        nts.NeoHookean(young=5e6, poisson=0.0),
        density=DENSITY,
        bcs=[nts.Dirichlet(lambda x: x[2] < -LAYER + 1e-9)],
        name="layer",
    )
    rim = wheel.surface(lambda x: np.hypot(x[0], x[2] - centre) > RADIUS - 1e-6)
    pair = nts.ContactPair(
        slave=rim,
        master=layer.surface(lambda x: x[2] > -1e-9, smoothing=smoothing),
        friction=FRICTION,
    )
    return nts.System([wheel, layer], contacts=[pair], gravity=(0, 0, -GRAVITY))


class Recorder:
    """A writer that keeps the motion of the wheel as a whole, the same on all ranks."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        wheel = nts.motion_of(stepper.system.bodies[0])
        self.mass, self.inertia = wheel.mass, wheel.inertia[1, 1]
        self.rows = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        wheel = nts.motion_of(stepper.system.bodies[0])
        row = (stepper.state.time, *wheel.centre, wheel.velocity[0], wheel.spin[1])
        self.rows.append(row)

    def close(self, stepper):
        """Make columns of the rows."""
        self.time, self.x, _, self.height, self.speed, self.spin = np.array(self.rows).T


def rigid(t, kappa):
    """Speed of the centre and omega R of the rigid wheel at times t from the throw, shape (n,)."""
    end = SPEED / (FRICTION * GRAVITY * (1 + 1 / kappa))
    t = np.minimum(t, end)
    return SPEED - FRICTION * GRAVITY * t, FRICTION * GRAVITY * t / kappa


def figures(run, wheel):
    """The wheel against the rigid one; speeds over v0, energies over m v0^2 / 2."""
    t, b = wheel.time, run.balance
    kappa = wheel.inertia / wheel.mass / RADIUS**2
    energy = wheel.mass * SPEED**2 / 2
    speed, spin = rigid(t, kappa)
    end = SPEED / (FRICTION * GRAVITY * (1 + 1 / kappa))
    met = np.flatnonzero(wheel.spin * RADIUS >= wheel.speed)
    rolls = t > 0.5 * (end + t[-1])
    return {
        "slide_end": float(t[met[0]] / end) if len(met) else np.inf,
        "speed": float(wheel.speed[rolls].mean() / SPEED) if rolls.any() else np.nan,
        "spin": float(wheel.spin[rolls].mean() * RADIUS / SPEED) if rolls.any() else np.nan,
        "dissipated": float(b["friction_dissipation"][-1] / energy),
        "energy_lost": float(-(b["energy"] - b["external_work"])[[0, -1]] @ [-1, 1] / energy),
        "speed_error": float(np.abs(wheel.speed - speed).max() / SPEED),
        "spin_error": float(np.abs(wheel.spin * RADIUS - spin).max() / SPEED),
        "kappa": float(kappa),
        "ledger": float(np.abs(b["ledger_residual"]).max() / energy),
        "contact_defect": float(b["contact_defect"][-1] / energy),
        "facet_changes": len(run.switches),
        "facet_change_energy": sum(abs(s.defect) for s in run.switches) / float(energy),
        "off_ground": float((b["active"][1:] == 0).mean()),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": t, "speed": wheel.speed, "spin": wheel.spin, "height": wheel.height},
    }


def plot(results, balances, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dolfinx_nts.output.plots import compare_balances

    folder.mkdir(parents=True, exist_ok=True)
    compare_balances(balances, str(folder / "balance.png"))
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    # One lies on the other.
    for width, (name, r) in zip((3.0, 1.0), results.items(), strict=False):
        h = r["history"]
        (line,) = axis.plot(h["time"], h["speed"], lw=width, label=f"speed of the centre, {name}")
        axis.plot(h["time"], h["spin"] * RADIUS, "--", lw=width, color=line.get_color(),
                  label=f"spin times radius, {name}")  # fmt: skip
    t = np.linspace(0, h["time"][-1], 501)
    for k, values in enumerate(rigid(t, 0.5)):
        axis.plot(t, values, "k:", lw=1, label=None if k else "rigid cylinder")
    axis.set(xlabel="time [s]", ylabel="[m/s]")
    axis.legend(fontsize="small")
    figure.savefig(folder / "rolling.png", dpi=150)
    plt.close(figure)


def report(results, facets):
    print(f"wheel with {facets} facets on an elastic layer")
    print(f"{'':16}" + "".join(f"{name:>19}" for name in ("rigid cylinder", *results)))
    right = {"slide_end": 1.0, "speed": 2 / 3, "spin": 2 / 3, "dissipated": 1 / 3,
             "energy_lost": 1 / 3, "ledger": 0.0}  # fmt: skip
    for name in SHOWN:
        row = [right[name], *(r[name] for r in results.values())]
        print(f"{name:16}" + "".join(f"{x:>19.5g}" for x in row))
    for name, r in results.items():
        print(
            f"{name}: {r['status']}, {r['retries']} retries, {r['newton_iterations']:.2f} "
            f"iterations a step, off the ground {100 * r['off_ground']:.0f} % of the steps, "
            f"{r['facet_changes']} changes of facet with {r['facet_change_energy']:.2g} of the "
            f"energy, {r['seconds']:.0f} s"
        )


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    facets=48,
    smoothing=False,
    dt=4e-3,
    duration=0.7,
    integrators=tuple(INTEGRATORS),
    progress=False,
):
    """Throw the wheel with each integrator.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        facets: Facets around the rim, a multiple of 8.
        smoothing: Whether the layer is a smooth surface through its nodes.
        dt: Step [s].
        duration: From the throw to the end of the run [s].
        integrators: Which of "energy-momentum", "midpoint".
        progress: Show a progress line.

    Returns:
        {integrator: figures}; see `figures`.
    """
    meshes = wheel_mesh(comm, facets, max(2, facets // 16)), ground_mesh(comm)
    settled = nts.equilibrium(
        scene(*meshes, facets, settle=True, smoothing=smoothing), load_steps=4, progress=progress
    )
    results, balances = {}, {}
    for name in integrators:
        wheel, clock = Recorder(), time.perf_counter()
        system = scene(*meshes, facets, settle=False, smoothing=smoothing)
        folder, writers = output and Path(output) / name, [wheel]
        if folder:
            film = Film(folder / "film.gif", interval=duration / 30)
            writers += [Fields(folder, every=5), film]
        run = nts.simulate(
            system,
            INTEGRATORS[name],
            dt=dt,
            t_end=duration,
            output=writers,
            progress=progress,
            start=settled,
            start_time=0.0,
        )
        if folder:
            picture(run, folder / "wheel.png", view=(10.0, -75.0))
        results[name] = figures(run, wheel)
        results[name]["seconds"] = time.perf_counter() - clock
        balances[name] = run.balance
    if comm.rank == 0:
        report(results, facets)
        if output is not None:
            plot(results, balances, Path(output))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/rolling", help="pictures and fields")
    parser.add_argument("--facets", type=int, default=48)
    parser.add_argument("--smoothing", action="store_true", help="of the layer")
    parser.add_argument("--dt", type=float, default=4e-3)
    main(progress=True, **vars(parser.parse_args()))
