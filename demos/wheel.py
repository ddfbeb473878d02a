"""A wheel with a rigid rim and a rubber tyre carries a load over a step.

Problem. A rigid rim (radius 0.22, density 2700) wears a tyre of rubber (to radius 0.3, 0.1 wide,
E = 2e6, nu = 0.4, density 1100), a ring of hexahedra whose inner nodes are tied to the rim. A
revolute joint, the axle, holds a carriage of 40 kg, which a planar joint keeps upright across the
way; g = 9.81, friction 0.6. The wheel stands in equilibrium and is then given 1.5 m/s and the spin
that a wheel of its radius needs. At 0.55 m the rigid ground rises by 20 mm within 60 mm.

Reference. A tyre rolls without slip, so that its tread, which hardly stretches, is laid down as it
is long: the way over the angle, R_eff, is the radius of its polygon's length, though the axle is
lower. The axle carries what the carriage needs, F = m (a + g); the forces of the ground, of the
guide and of weight are the change of linear momentum. Lifted by the step s the wheel must give
m g s of its energy of rolling, 1/2 m v^2 + 1/2 I omega^2.

What to see. Before the step R_eff is 0.1 % above the radius of the tread's length, and the axle is
1 % below it; one in a hundred of the nodes in contact slips, as it comes down. The step loads the
axle with five times the weight and throws the wheel off the ground. Rolling loses 23 % of its
energy, of which the lift needs 14 %; friction and closing gaps (the contact defect) take 0.3 %, and
the rest shakes tyre and carriage. The ledger closes to round-off, and so do the balances of
momentum, of all and of the carriage alone. The axle's force swings by a quarter before the step,
too: the tyre is a polygon, whose nodes come down one after another.

    mpirun -n 2 python demos/wheel.py
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

#: Radii of hub, bead and tread, and the width [m].
HUB, BEAD, TREAD, WIDTH = 0.18, 0.22, 0.3, 0.1
LOAD, SPEED, GRAVITY, FRICTION = 40.0, 1.5, 9.81, 0.6
#: Where the ground rises, over which length, and by how much [m].
AT, LONG, STEP = 0.55, 0.06, 0.02
Y = np.array([0.0, 1.0, 0.0])
SHOWN = ("height", "effective", "tread", "slipped", "peak", "lowest", "speed", "lift", "lost",
         "friction", "contact_defect", "ledger", "momentum", "carriage")  # fmt: skip


def ring(comm, radii, facets, centre, width=WIDTH):
    """Hexahedra between these radii about an axle along y, built on rank 0; a flat below."""
    angle = 2 * np.pi * (np.arange(facets) + 0.5) / facets
    r, y, t = np.meshgrid(radii, [-0.5 * width, 0.5 * width], angle, indexing="ij")
    points = np.column_stack([(r * np.sin(t)).ravel(), y.ravel(), -(r * np.cos(t)).ravel()])
    here = np.arange(len(points)).reshape(r.shape)
    sides = [
        n[a, b] for n in (here, np.roll(here, -1, axis=2))
        for b in (slice(None, -1), slice(1, None)) for a in (slice(None, -1), slice(1, None))
    ]  # fmt: skip
    cells, points = np.column_stack([side.ravel() for side in sides]), points + centre
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    return create_mesh(comm, cells, points, "hexahedron")


def rise(x):
    """Height of the ground [m], shape of x."""
    s = np.clip((x - AT) / LONG, 0.0, 1.0)
    return STEP * s * s * (3 - 2 * s)


def ground(comm):
    """The rigid ground, which does not move; cells of 25 mm along the way."""
    mesh = create_box(
        comm, [[-0.25, -0.6 * WIDTH, -0.05], [1.5, 0.6 * WIDTH, 0.0]], [70, 1, 1],
        CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x = mesh.geometry.x
    top = x[:, 2] > -0.01
    x[top, 2] = rise(x[top, 0])
    return nts.RigidBody(mesh, density=2e3, motion=(0, 0, 0), rotation=(0, 0, 0), name="ground")


def scene(comm, facets, *, settle):
    """Wheel and carriage; while they settle, the top of the tread may not move along the way."""
    low = np.cos(np.pi / facets)
    centre = np.array([0.0, 0.0, TREAD * low])
    spin = SPEED / TREAD * Y

    def distance(x):
        return np.hypot(x[0] - centre[0], x[2] - centre[2])

    def rolling(x):
        return np.cross(spin, (x - centre[:, None]).T).T + np.array([[SPEED], [0.0], [0.0]])

    top = nts.Dirichlet(lambda x: x[2] > centre[2] + TREAD * low - 1e-6, components=(0,))
    tyre = nts.Continuum(
        ring(comm, np.linspace(BEAD, TREAD, 3), facets, centre),
        nts.NeoHookean(young=2e6, poisson=0.4), density=1100.0, velocity=rolling,
        bcs=[top] if settle else [], name="tyre",
    )  # fmt: skip
    rim = nts.RigidBody(
        ring(comm, [HUB, BEAD], facets, centre), density=2700.0, velocity=(SPEED, 0, 0),
        angular_velocity=spin, name="rim",
    )  # fmt: skip
    carriage = nts.RigidBody.from_inertia(
        LOAD, 3 * [1.0], centre, velocity=(SPEED, 0, 0), name="carriage", comm=comm
    )
    floor = ground(comm)
    joints = [
        nts.Tie(rim, tyre.surface(lambda x: distance(x) < BEAD + 1e-6), name="bead"),
        nts.Revolute(rim, carriage, point=centre, axis=Y, name="axle"),
        nts.Planar(carriage, None, point=centre, axis=Y, name="guide"),
    ]
    pair = nts.ContactPair(
        slave=tyre.surface(lambda x: distance(x) > TREAD * low - 1e-6),
        master=floor.surface(lambda x: x[2] > rise(x[0]) - 1e-9),
        friction=FRICTION,
    )
    return nts.System([tyre, rim, carriage, floor], joints=joints, contacts=[pair],
                      gravity=(0, 0, -GRAVITY))  # fmt: skip


class Recorder:
    """A writer that keeps place and velocity of the carriage and the spin of the rim."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.rows = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        _, rim, carriage, _ = stepper.system.bodies
        spin = rim.angular_velocity[1]
        self.rows.append((stepper.state.time, *carriage.position, *carriage.velocity, spin))

    def close(self, stepper):
        """Make columns of the rows."""
        table = np.array(self.rows)
        self.time, self.place, self.velocity = table[:, 0], table[:, 1:4], table[:, 4:7]
        self.spin = table[:, 7]


def unexplained(run, path):
    """Return the change of momentum per step less impulses [kg m/s], of all and of the carriage."""
    step = np.diff(path.time)[:, None]
    weight = np.array([0.0, 0.0, -GRAVITY])
    mass = sum(nts.motion_of(body).mass for body in run.system.bodies[:3])
    guide, axle = (run.reactions[name][1:, 0] for name in ("guide", "axle"))
    whole = run.contact_forces[1:, 0] + guide + mass * weight
    alone = guide - axle + LOAD * weight
    return (
        np.diff(run.balance["linear_momentum"], axis=0) - step * whole,
        LOAD * np.diff(path.velocity, axis=0) - step * alone,
    )


def figures(run, path, facets):
    """Lengths in m, forces over the carriage's weight, energies over that of rolling before."""
    b, x = run.balance, path.place[:, 0]
    tyre, rim, *_ = (nts.motion_of(body) for body in run.system.bodies[:3])
    mass = LOAD + tyre.mass + rim.mass
    inertia = tyre.inertia[1, 1] + rim.inertia[1, 1]
    # The tread meets the rise before the axle is there.
    flat = x < AT - np.sqrt(2 * TREAD * STEP)
    turned = np.diff(path.time) * 0.5 * (path.spin[1:] + path.spin[:-1])
    rolling = 0.5 * mass * path.velocity[:, 0] ** 2 + 0.5 * inertia * path.spin**2
    before = rolling[flat].mean()
    # The last tenth of the run holds some swings of the tyre.
    after = rolling[-max(1, len(x) // 10) :].mean()
    axle = -run.reactions["axle"][1:, 0, 2] / (LOAD * GRAVITY)
    momentum = np.abs(b["linear_momentum"]).max()
    missing = [float(np.abs(part).max() / momentum) for part in unexplained(run, path)]
    return {
        "height": float(path.place[flat, 2].mean()),
        "effective": float(np.diff(x)[flat[1:]].sum() / turned[flat[1:]].sum()),
        "tread": float(TREAD * np.sin(np.pi / facets) / (np.pi / facets)),
        "slipped": float(b["slip"][flat].sum() / max(1, b["active"][flat].sum())),
        "pressed": float(run.contact_forces[1:, 0, 2][flat[1:]].mean() / (mass * GRAVITY)),
        "peak": float(axle.max()),
        "lowest": float(axle[flat[1:]].min()),
        "speed": float(path.velocity[-1, 0] / SPEED),
        "lift": float(mass * GRAVITY * rise(x[-1]) / before),
        "lost": float(1.0 - after / before),
        "friction": float(b["friction_dissipation"][-1] / before),
        "contact_defect": float(b["contact_defect"][-1] / before),
        "ledger": float(np.abs(b["ledger_residual"]).max() / b["energy"][0]),
        "momentum": missing[0],
        "carriage": missing[1],
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": path.time, "place": path.place, "axle": axle,
                    "speed": path.velocity[:, 0], "spin": path.spin},
    }  # fmt: skip


def plot(r, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    h = r["history"]
    figure, axes = plt.subplots(3, 1, figsize=(8, 8), sharex=True, layout="constrained")
    x = h["place"][:, 0]
    axes[0].plot(x, h["place"][:, 2], label="axle")
    axes[0].plot(x, TREAD + rise(x), "k:", label="ground + radius")
    axes[0].set(ylabel="height [m]")
    axes[1].plot(x, h["speed"], label="speed")
    axes[1].plot(x, r["tread"] * h["spin"], label="spin times radius of the tread's length")
    axes[1].set(ylabel="[m/s]")
    axes[2].plot(x[1:], h["axle"], label="vertical force of the axle / weight of the carriage")
    axes[2].set(xlabel="x [m]", ylabel="[-]")
    for axis in axes:
        axis.legend(fontsize="small")
    figure.savefig(folder / "step.png", dpi=150)
    plt.close(figure)


def report(what, r, shown):
    """Print figures of a run of something."""
    print(f"{what}: {r['status']}")
    for name in shown:
        print(f"  {name:16}{r[name]:>12.5g}")
    print(f"  {r['newton_iterations']:.2f} iterations a step, {r['retries']} retries, "
          f"{r['seconds']:.0f} s")  # fmt: skip


def main(
    *, comm=MPI.COMM_WORLD, output=None, facets=36, dt=2e-3, duration=0.6, progress=False
):
    """Let the wheel settle, and roll.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        facets: Around the tyre, even.
        dt: Step [s].
        duration: Of rolling [s].
        progress: Show a progress line.

    Returns:
        Figures; see `figures`.
    """
    clock, path = time.perf_counter(), Recorder()
    settled = nts.equilibrium(scene(comm, facets, settle=True), load_steps=4, progress=progress)
    system, folder = scene(comm, facets, settle=False), output and Path(output)
    writers = [path]
    if folder:
        film = Film(folder / "film.gif", interval=max(duration / 30, dt))
        writers += [Fields(folder, interval=max(duration / 60, dt)), film]
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=duration, start=settled, start_time=0.0,
        progress=progress, output=writers,
    )  # fmt: skip
    r = figures(run, path, facets) | {"seconds": time.perf_counter() - clock}
    if folder:
        picture(run, folder / "wheel.png", view=(10.0, -80.0))
    if comm.rank == 0:
        report(f"tyre of {facets} facets over a step", r, SHOWN)
        if folder:
            plot(r, folder)
    return r


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/wheel", help="pictures and fields")
    parser.add_argument("--facets", type=int, default=36, help="even")
    parser.add_argument("--dt", type=float, default=2e-3, help="[s]")
    parser.add_argument("--duration", type=float, default=0.6, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
