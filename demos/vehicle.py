"""A vehicle on four rubber tyres brakes: deceleration and load transfer beside their closed forms.

Problem. A chassis of 400 kg (wheelbase 2.4, track 1.3) stands on four wheels. Each is a rigid rim
with a tyre, a ring of hexahedra of rubber (E = 3e6, nu = 0.4, density 1100) that is tied to the
rim. The rim turns on a hub of 8 kg in a revolute joint, and the hub slides upright on the chassis
in a prismatic joint with limits, a spring (20 kN/m) and a damper (1.5 kN s/m) beside it. The
vehicle rolls at 3 m/s on a plane, friction 0.8, g = 9.81; after 0.4 s a motor in each revolute
joint brakes with 60 N m. Nothing is prescribed and nothing guides the vehicle.

Reference. Wheels that do not slide turn by the way over R, the radius of the tread's length. With
the mass M, the inertia I of all that turns, the height h of the centre of mass, the wheelbase L and
the torques T of all brakes

    a = (T / R) / (M + I / R^2),     N_front - N_rear = 2 (M a h + I a / R) / L.

What to see. The mean deceleration is 2 % above that of the closed form, and the load that goes
from the rear axle to the front 3 %. Tyres are polygons whose nodes come down one after another:
what that takes (the contact defect, 1 % of the energy) is the resistance of rolling, and the forces
of the ground swing by a fifth about their means. Friction takes a thousandth, as the wheels do not
slide. The ledger closes to the tolerance of its steps. The run warns of stress that jumps between
the cells of the tyres, as one or two facets of each carry all; forces and motion do not need it.

    mpirun -n 2 python demos/vehicle.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box
from wheel import report, ring

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

GRAVITY, FRICTION = 9.81, 0.8
#: Mass of chassis and of each hub [kg].
CHASSIS, HUB = 400.0, 8.0
#: Wheelbase, track, length of a strut; corners of the chassis [m].
BASE, TRACK, STRUT = 2.4, 1.3, 0.35
LOW, HIGH = (-1.5, -0.5, 0.4), (1.5, 0.5, 0.7)
STIFFNESS, DAMPING = 2e4, 1.5e3
#: Radii of hub, bead and tread, and the width of a tyre [m].
INNER, BEAD, TREAD, WIDTH = 0.18, 0.22, 0.3, 0.12
SPEED, TORQUE, START = 3.0, 60.0, 0.4
Y, Z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
CORNERS = {
    "front left": (0.5, 0.5), "front right": (0.5, -0.5),
    "rear left": (-0.5, 0.5), "rear right": (-0.5, -0.5),
}  # fmt: skip
SHOWN = ("deceleration", "closed", "transfer", "closed_transfer", "weight", "braked", "friction",
         "contact_defect", "damping", "ledger")  # fmt: skip


def brake(t, angle, rate):
    """Torque of a brake on its rim [N m], which no sign of a wheel at rest lets jump."""
    return -TORQUE * np.tanh(rate / 0.2) if t > START else 0.0


def wheel(comm, name, centre, chassis, facets):
    """Tyre, rim and hub about a centre, the joints to the chassis, and the tread."""
    spin, low = SPEED / TREAD * Y, np.cos(np.pi / facets)

    def distance(x):
        return np.hypot(x[0] - centre[0], x[2] - centre[2])

    def rolling(x):
        return np.cross(spin, (x - centre[:, None]).T).T + np.array([[SPEED], [0.0], [0.0]])

    tyre = nts.Continuum(
        ring(comm, np.linspace(BEAD, TREAD, 3), facets, centre, WIDTH),
        nts.NeoHookean(young=3e6, poisson=0.4), density=1100.0, velocity=rolling,
        name=f"tyre {name}",
    )  # fmt: skip
    rim = nts.RigidBody(
        ring(comm, [INNER, BEAD], facets, centre, WIDTH), density=2700.0, velocity=(SPEED, 0, 0),
        angular_velocity=spin, name=f"rim {name}",
    )  # fmt: skip
    hub = nts.RigidBody.from_inertia(
        HUB, 3 * [0.1], centre, velocity=(SPEED, 0, 0), name=f"hub {name}", comm=comm
    )
    strut = (centre, centre + STRUT * Z)
    free = STRUT + CHASSIS * GRAVITY / len(CORNERS) / STIFFNESS
    joints = [
        nts.Tie(rim, tyre.surface(lambda x: distance(x) < BEAD + 1e-6), name=f"bead {name}"),
        nts.Revolute(rim, hub, point=centre, axis=Y, motor=brake, name=f"axle {name}"),
        nts.Prismatic(
            hub, chassis, point=centre, axis=Z, limits=(-0.1, 0.1), name=f"strut {name}"
        ),
        nts.Spring(hub, chassis, strut, stiffness=STIFFNESS, length=free, name=f"spring {name}"),
        nts.Damper(hub, chassis, strut, damping=DAMPING, name=f"damper {name}"),
    ]
    tread = tyre.surface(lambda x: distance(x) > TREAD * low - 1e-6)
    return [tyre, rim, hub], joints, tread


def scene(comm, facets):
    """The vehicle, rolling; its springs carry the chassis, and its tyres are still round."""
    box = create_box(comm, [LOW, HIGH], [6, 2, 1], CellType.hexahedron)
    density = CHASSIS / np.prod(np.subtract(HIGH, LOW))
    chassis = nts.RigidBody(box, density=density, velocity=(SPEED, 0, 0), name="chassis")
    road = nts.Plane((0, 0, 0), Z, name="road")
    bodies, joints, contacts = [chassis], [], []
    for name, (x, y) in CORNERS.items():
        centre = np.array([x * BASE, y * TRACK, TREAD * np.cos(np.pi / facets)])
        own, held, tread = wheel(comm, name, centre, chassis, facets)
        bodies += own
        joints += held
        contacts.append(nts.ContactPair(tread, road, friction=FRICTION))
    return nts.System(bodies, joints=joints, contacts=contacts, gravity=(0, 0, -GRAVITY))


def closed_forms(system, facets):
    """Mass [kg], deceleration [m/s^2] and load that goes from the rear to the front [N]."""
    moved = {body.name: nts.motion_of(body) for body in system.bodies}
    mass = sum(m.mass for m in moved.values())
    height = sum(m.mass * m.centre[2] for m in moved.values()) / mass
    turning = sum(m.inertia[1, 1] for name, m in moved.items() if name.startswith(("tyre", "rim")))
    radius = TREAD * np.sin(np.pi / facets) / (np.pi / facets)
    slowed = len(CORNERS) * TORQUE / radius / (mass + turning / radius**2)
    return mass, slowed, 2 * slowed * (mass * height + turning / radius) / BASE


class Recorder:
    """A writer that keeps the speed of the chassis."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.speed = []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        self.speed.append(stepper.system.bodies[0].velocity[0])

    def close(self, stepper):
        """Make an array of it."""
        self.speed = np.array(self.speed)


def figures(run, speed, closed):
    """Decelerations in m/s^2, loads over the weight, energies over that at the start."""
    b, (mass, slowed, transfer) = run.balance, closed
    weight, start = mass * GRAVITY, b["energy"][0]
    ground = run.contact_forces[:, :, 2] / weight
    # The first half of braking sets the chassis pitching.
    end = b["time"][-1]
    late = b["time"] >= min(0.5 * (START + end), end)
    braking = b["time"] > START + 1e-9
    way = np.polyfit(b["time"][braking], speed[braking], 1)[0] if braking.sum() > 2 else np.nan
    return {
        "deceleration": float(-way),
        "closed": float(slowed),
        "transfer": float((ground[late, :2].sum(axis=1) - ground[late, 2:].sum(axis=1)).mean()),
        "closed_transfer": float(transfer / weight),
        "weight": float(ground[late].sum(axis=1).mean()),
        "braked": float(-b["external_work"][-1] / start),
        "friction": float(b["friction_dissipation"][-1] / start),
        "contact_defect": float(b["contact_defect"][-1] / start),
        "damping": float(b["damping_dissipation"][-1] / start),
        "ledger": float(np.abs(b["ledger_residual"]).max() / start),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": b["time"], "speed": speed, "ground": ground},
    }


def plot(r, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    h = r["history"]
    figure, axes = plt.subplots(2, 1, figsize=(8, 6), sharex=True, layout="constrained")
    axes[0].plot(h["time"], h["speed"], label="chassis")
    later = h["time"] > START
    closed = SPEED - r["closed"] * (h["time"][later] - START)
    axes[0].plot(h["time"][later], closed, "k:", label="closed form of the braking")
    axes[0].set(ylabel="speed [m/s]")
    for k, label in ((0, "front wheels"), (2, "rear wheels")):
        axes[1].plot(h["time"], h["ground"][:, k : k + 2].sum(axis=1), label=label)
    axes[1].set(xlabel="time [s]", ylabel="force of the road / weight [-]")
    for axis in axes:
        axis.legend(fontsize="small")
    figure.savefig(folder / "braking.png", dpi=150)
    plt.close(figure)


def main(*, comm=MPI.COMM_WORLD, output=None, facets=24, dt=5e-3, t_end=1.0, progress=False):
    """Let the vehicle roll, and brake.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        facets: Around each tyre.
        dt: Step [s].
        t_end: [s].
        progress: Show a progress line.

    Returns:
        Figures; see `figures`.
    """
    clock, system, path = time.perf_counter(), scene(comm, facets), Recorder()
    closed, folder = closed_forms(system, facets), output and Path(output)
    writers = [path]
    if folder:
        film = Film(folder / "film.gif", interval=max(t_end / 40, dt), view=(15.0, -70.0))
        writers += [Fields(folder, interval=max(t_end / 40, dt)), film]
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=t_end, accuracy="balanced", progress=progress,
        output=writers,
    )  # fmt: skip
    r = figures(run, path.speed, closed) | {"seconds": time.perf_counter() - clock}
    if folder:
        picture(run, folder / "vehicle.png", view=(15.0, -70.0))
    if comm.rank == 0:
        report("a vehicle brakes", r, SHOWN)
        if folder:
            plot(r, folder)
    return r


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/vehicle", help="pictures and fields")
    parser.add_argument("--facets", type=int, default=24, help="around each tyre")
    parser.add_argument("--dt", type=float, default=5e-3, help="[s]")
    parser.add_argument("--t-end", type=float, default=1.0, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
