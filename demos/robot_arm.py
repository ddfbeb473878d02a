"""An arm with motors in its joints grips a box, lifts it and swings it round, or lets it slip.

Problem. A post turns on the ground, an upper arm (0.5 long) in it, a forearm (0.4) in that, and a
hand in the wrist. Each of the four revolute joints has limits and a motor, a controller with a
stiffness and a damping that follows a given angle. Two fingers slide in the hand in prismatic
joints, and motors press them together with 20 N each; they wear pads of rubber (E = 1e6, nu = 0.3).
A rigid box of 1 kg stands on a table between them. The fingers press in 0.1 s, the arm lifts by
0.15 from 0.2 s to 0.8 s, and the post turns by a right angle until 1.4 s; g = 9.81.

Reference. Two fingers of force F carry a box at rest if mu > m g / (2 F). Held at rest by a
controller of stiffness k, an angle falls short of the given one by M / k, with the moment M about
its axis of all weights beyond the joint.

What to see. With 1.5 times that coefficient of friction the box follows the hand; it creeps by 2 mm
in the pads while it is swung. With 0.8 times it stays on the table, and the fingers slide off. At
the end shoulder and elbow fall short by M / k within 1 %. The ledger closes to round-off: motors
have lifted, and friction took most of the rest.

    mpirun -n 2 python demos/robot_arm.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

GRAVITY, STEEL, RUBBER = 9.81, 2000.0, 1100.0
#: Lengths of upper arm and forearm; the shoulder; the wrist at the start [m].
UPPER, FORE = 0.5, 0.4
SHOULDER, WRIST = np.array([0.0, 0.0, 0.5]), np.array([0.6, 0.0, 0.25])
#: Length of the hand, and where the box is from its centre [m].
HAND, BELOW = 0.1, np.array([0.0, 0.0, -0.13])
#: Edge of the box [m] and its mass [kg].
EDGE, MASS = 0.08, 1.0
GRIP, RISE, TURN = 20.0, 0.15, 0.5 * np.pi
#: When the arm begins to lift, has lifted, and the post has turned [s].
CLOSED, LIFTED, TURNED = 0.2, 0.8, 1.4
#: Stiffness [N m] and damping [N m s] of the controllers.
STIFFNESS = {"column": 2e3, "shoulder": 6e3, "elbow": 3e3, "wrist": 3e2}
DAMPING = {"column": 1e2, "shoulder": 2e2, "elbow": 1e2, "wrist": 1e1}
#: Over the coefficient of friction that carries the box.
FACTORS = {"holds": 1.5, "slips": 0.8}
LIFT = np.array([0.0, -1.0, 0.0])
SHOWN = ("rise", "turned", "slipped", "shoulder", "shoulder_closed", "elbow", "elbow_closed",
         "work", "dissipated", "contact_defect", "ledger")  # fmt: skip


def pose(wrist):
    """Angles of upper arm and forearm over the horizontal [rad] with the wrist at a place (3,)."""
    x, z = wrist[0] - SHOULDER[0], wrist[2] - SHOULDER[2]
    far = np.hypot(x, z)
    inside = np.arccos((UPPER**2 + far**2 - FORE**2) / (2 * UPPER * far))
    upper = np.arctan2(z, x) + inside
    elbow = SHOULDER + UPPER * np.array([np.cos(upper), 0.0, np.sin(upper)])
    return upper, np.arctan2(wrist[2] - elbow[2], wrist[0] - elbow[0])


def smooth(t, start, end):
    """From 0 to 1 between two times, with rates of 0 at both."""
    s = min(max((t - start) / (end - start), 0.0), 1.0)
    return s * s * (3 - 2 * s)


def targets(t):
    """Given angles of the joints at a time, from the start [rad]."""
    first, now = pose(WRIST), pose(WRIST + [0, 0, RISE * smooth(t, CLOSED, LIFTED)])
    upper, fore = now[0] - first[0], now[1] - first[1]
    return {
        "column": TURN * smooth(t, LIFTED, TURNED),
        "shoulder": upper, "elbow": fore - upper, "wrist": -fore,
    }  # fmt: skip


def controller(name):
    """The motor of a joint, which follows its given angle."""

    def torque(t, angle, rate):
        wanted, later = targets(t)[name], targets(t + 1e-4)[name]
        speed = (later - wanted) / 1e-4
        return STIFFNESS[name] * (wanted - angle) + DAMPING[name] * (speed - rate)

    return torque


def box(comm, centre, size, cells, axes=None):
    """Hexahedra of a box about a centre, along axes (3, 3) in rows."""
    half = 0.5 * np.asarray(size)
    mesh = create_box(comm, [-half, half], list(cells), CellType.hexahedron)
    mesh.geometry.x[:] = mesh.geometry.x @ (np.eye(3) if axes is None else axes) + centre
    return mesh


def link(comm, start, end, thick, name):
    """A rigid bar between two points of the plane y = 0."""
    along = (end - start) / np.linalg.norm(end - start)
    axes = np.array([along, [0, 1, 0], np.cross(along, [0, 1, 0])])
    size = (np.linalg.norm(end - start), thick, thick)
    mesh = box(comm, 0.5 * (start + end), size, (1, 1, 1), axes)
    return nts.RigidBody(mesh, density=STEEL, name=name)


def face(body, value):
    """The part of its boundary in which y has this value."""
    return body.surface(lambda x: np.abs(x[1] - value) < 1e-9)


def scene(comm, friction):
    """Arm, box and table."""
    upper, _ = pose(WRIST)
    elbow = SHOULDER + UPPER * np.array([np.cos(upper), 0.0, np.sin(upper)])
    hand, held = WRIST - [0, 0, HAND], WRIST - [0, 0, 0.5 * HAND] + BELOW
    names = ("column", "shoulder", "elbow", "wrist")
    post = link(comm, np.array([0, 0, 0.02]), SHOULDER, 0.08, "post")
    bars = [
        post, link(comm, SHOULDER, elbow, 0.06, "upper arm"),
        link(comm, elbow, WRIST, 0.05, "forearm"), link(comm, WRIST, hand, 0.04, "hand"),
    ]  # fmt: skip
    at = (np.zeros(3), SHOULDER, elbow, WRIST)
    joints = [
        nts.Revolute(
            body, before, point=place, axis=(0, 0, 1) if name == "column" else LIFT,
            limits=(-2.5, 2.5), motor=controller(name), name=name,
        )
        for body, before, place, name in zip(bars, [None, *bars], at, names, strict=False)
    ]  # fmt: skip
    load = nts.RigidBody(
        box(comm, held, 3 * [EDGE], (2, 2, 2)), density=MASS / EDGE**3, name="box"
    )
    table = nts.Plane(held - [0, 0, 0.5 * EDGE], (0, 0, 1), name="table")
    bodies, contacts = [*bars, load], []
    for name, side in (("left", 1.0), ("right", -1.0)):
        inner = side * 0.5 * EDGE
        pad = nts.Continuum(
            box(comm, [held[0], inner + side * 0.005, held[2]], (0.03, 0.01, 0.03), (2, 2, 2)),
            nts.NeoHookean(young=1e6, poisson=0.3), density=RUBBER, name=f"{name} pad",
        )  # fmt: skip
        centre = [held[0], inner + side * 0.02, held[2] + 0.04]
        finger = nts.RigidBody(
            box(comm, centre, (0.03, 0.02, 0.12), (1, 1, 2)), density=STEEL, name=f"{name} finger"
        )

        def press(t, way, rate, side=side):
            return -side * GRIP * smooth(t, 0.0, 0.5 * CLOSED) - 50.0 * rate

        joints += [
            nts.Prismatic(
                finger, bars[-1], point=centre, axis=(0, 1, 0), limits=(-0.03, 0.03), motor=press,
                name=f"{name} slide",
            ),
            nts.Tie(finger, face(pad, inner + side * 0.01), name=f"{name} glue"),
        ]  # fmt: skip
        contacts.append(
            nts.ContactPair(face(pad, inner), face(load, inner), friction=friction)
        )
        bodies += [finger, pad]
    below = load.surface(lambda x: x[2] < held[2] - 0.5 * EDGE + 1e-9)
    contacts.append(nts.ContactPair(below, table, friction=0.3))
    return nts.System(bodies, joints=joints, contacts=contacts, gravity=(0, 0, -GRAVITY))


def beyond(system, names, point):
    """Moment of the weights of bodies about a horizontal axis through a point [N m]."""
    moved = [nts.motion_of(body) for body in system.bodies if body.name in names]
    weight = GRAVITY * np.array([m.mass for m in moved])
    arms = np.array([m.centre - point for m in moved])
    return float(weight @ np.hypot(arms[:, 0], arms[:, 1]))


class Recorder:
    """A writer that keeps the place of the box and the angles of upper arm and forearm."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.rows, self.body = [], {body.name: body for body in stepper.system.bodies}
        self.axes = {name: self.body[name].rotation.copy() for name in ("upper arm", "forearm")}
        self.write(stepper)

    def angle(self, name):
        """By which a bar is lifted since the start [rad]."""
        along = {"upper arm": pose(WRIST)[0], "forearm": pose(WRIST)[1]}[name]
        first = np.array([np.cos(along), 0.0, np.sin(along)])
        now = self.body[name].rotation @ self.axes[name].T @ first
        return np.arctan2(now[2], np.hypot(now[0], now[1])) - along

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        upper, fore = self.angle("upper arm"), self.angle("forearm")
        self.rows.append((stepper.state.time, *self.body["box"].position, upper, fore - upper))

    def close(self, stepper):
        """Make columns of the rows."""
        self.time, *place, self.shoulder, self.elbow = np.array(self.rows).T
        self.place = np.column_stack(place)


def figures(run, path):
    """Return what the run says: lengths in m, angles in rad, energies in J."""
    b, system, place = run.balance, run.system, path.place
    body = {body.name: body for body in system.bodies}
    wanted = targets(path.time[-1])
    hand = nts.motion_of(body["hand"]).centre
    elbow = SHOULDER + 2 * (nts.motion_of(body["upper arm"]).centre - SHOULDER)
    carried = ["forearm", "hand", "left finger", "right finger", "left pad", "right pad"]
    if place[-1, 2] - place[0, 2] > 0.5 * RISE:
        carried.append("box")
    moments = {
        "elbow": beyond(system, carried, elbow),
        "shoulder": beyond(system, ["upper arm", *carried], SHOULDER),
    }
    return {
        "rise": float(place[-1, 2] - place[0, 2]),
        "turned": float(np.arctan2(place[-1, 1], place[-1, 0])),
        "slipped": float(np.linalg.norm(place[-1] - hand) - np.linalg.norm(BELOW)),
        "shoulder": float(wanted["shoulder"] - path.shoulder[-1]),
        "shoulder_closed": moments["shoulder"] / STIFFNESS["shoulder"],
        "elbow": float(wanted["elbow"] - path.elbow[-1]),
        "elbow_closed": moments["elbow"] / STIFFNESS["elbow"],
        "work": float(b["external_work"][-1]),
        "dissipated": float(b["friction_dissipation"][-1]),
        "contact_defect": float(b["contact_defect"][-1]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / np.ptp(b["external_work"])),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": path.time, "place": place, "shoulder": path.shoulder,
                    "elbow": path.elbow},
    }  # fmt: skip


def plot(results, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(2, 1, figsize=(8, 6), sharex=True, layout="constrained")
    for colour, (name, r) in zip(("C0", "C1"), results.items(), strict=False):
        h = r["history"]
        axes[0].plot(h["time"], h["place"][:, 2] - h["place"][0, 2], color=colour, label=name)
        axes[1].plot(h["time"], h["shoulder"], color=colour, label=f"shoulder, {name}")
        axes[1].plot(h["time"], h["elbow"], "--", color=colour, label=f"elbow, {name}")
    given = [targets(t) for t in h["time"]]
    for name in ("shoulder", "elbow"):
        axes[1].plot(h["time"], [angles[name] for angles in given], "k:", lw=1)
    axes[0].set(ylabel="rise of the box [m]")
    axes[1].set(xlabel="time [s]", ylabel="angle, given: dotted [rad]")
    for axis in axes:
        axis.legend(fontsize="small")
    figure.savefig(folder / "robot_arm.png", dpi=150)
    plt.close(figure)


def report(results):
    print(f"{'':18}" + "".join(f"{name:>12}" for name in results))
    for name in SHOWN:
        print(f"{name:18}" + "".join(f"{r[name]:>12.4g}" for r in results.values()))
    for name, r in results.items():
        print(
            f"{name}: {r['status']}, {r['retries']} retries, {r['newton_iterations']:.2f} "
            f"iterations a step, {r['seconds']:.0f} s"
        )


def main(
    *, comm=MPI.COMM_WORLD, output=None, cases=tuple(FACTORS), dt=1e-2, t_end=1.6, progress=False
):
    """Grip, lift and swing the box.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        cases: Which of "holds", "slips".
        dt: Step [s].
        t_end: [s].
        progress: Show a progress line.

    Returns:
        {case: figures}; see `figures`.
    """
    results = {}
    for case in cases:
        clock, path = time.perf_counter(), Recorder()
        system = scene(comm, FACTORS[case] * MASS * GRAVITY / (2 * GRIP))
        writers, folder = [path], output and Path(output) / case
        if folder:
            film = Film(folder / "film.gif", interval=max(t_end / 40, dt), view=(15.0, -60.0))
            writers += [Fields(folder, interval=max(t_end / 40, dt)), film]
        run = nts.simulate(
            system, nts.EnergyMomentum(), dt=dt, t_end=t_end, accuracy="balanced",
            progress=progress, output=writers,
        )  # fmt: skip
        if folder:
            picture(run, folder / "end.png", view=(15.0, -60.0), colour="body")
        results[case] = figures(run, path) | {"seconds": time.perf_counter() - clock}
    if comm.rank == 0:
        report(results)
        if output is not None:
            plot(results, Path(output))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/robot_arm", help="pictures and fields")
    parser.add_argument("--cases", nargs="+", choices=FACTORS, default=list(FACTORS))
    parser.add_argument("--dt", type=float, default=1e-2, help="[s]")
    parser.add_argument("--t-end", type=float, default=1.6, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
