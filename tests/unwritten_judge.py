"""Whether a run of a scene that no one wrote was right, stopped, or said what is wrong.

The judge knows nodes, cells and laws, and reads of the package what users read: displacements and
velocities of the bodies, the balance, warnings and status. What it computes from them shares no
code with the package.
"""

import re
import traceback
from functools import cached_property
from typing import NamedTuple

import numpy as np
from measures import PROMISED
from scipy.spatial import cKDTree
from unwritten_scenes import RULES, built

import dolfinx_nts as nts
from dolfinx_nts.output.state_file import previous

#: Depth over the longest edge of a facet, or the thickness of a body, from which a word is due.
DEEP = 0.5
#: Energy over the largest that may come from nowhere without a word (the package's 1 % twice).
GAIN = 0.02
EPS = np.finfo(float).eps
#: What an argument is named by in a message, and words of a remedy: what a value must be, or a verb
#: that tells the user what to do.
NAMED = re.compile(r"\w+(\[\d+\])?=|'[\w >-]+'|\b(bodies|contacts|joints|slave|surface|marker)\b")
REMEDY = re.compile(
    r"\b(must|[Pp]ass|[Cc]heck|[Cc]hoose|[Uu]se|[Ll]eave|[Dd]rop|[Mm]ake|[Ll]et|[Gg]ive|[Mm]ove|"
    r"[Dd]eclare|[Jj]oin|[Tt]ie|[Tt]ry|may prevent it)\b"
)
#: Tetrahedra at the corners of a hexahedron: a corner and its neighbours.
CORNER_TETS = np.array([[c, c ^ 1, c ^ 2, c ^ 4] for c in range(8)])
#: Edges of a tetrahedron.
PAIRS = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
#: Kinds of warnings that tell of bodies inside each other, and of bodies and obstacles.
OVERLAPS = {"edge through a body", "node inside a body"}
IN_OBSTACLES = {
    "facet in an obstacle", "node in an obstacle", "obstacle in a body",
    "facet starts in an obstacle",
}  # fmt: skip


class Verdict(NamedTuple):
    """Of a scene.

    Attributes:
        outcome: "refused", "crashed", "completed" or "stopped".
        said: The exception, or the status.
        wrong: Sentences on what is wrong.
        touched: Whether nodes were in contact.
    """

    outcome: str
    said: str
    wrong: list
    touched: bool = False


def judge(scene, comm):
    """Run a scene and judge it. Collective."""
    system = watch = None
    try:
        made = built(scene, comm)
        system, watch = made.system, Watch(made, comm)
        run = nts.simulate(system, output=[watch], **made.run)
    except (TypeError, ValueError) as error:
        text = str(error)
        good = NAMED.search(text) and REMEDY.search(text) and len(text) > 20
        where = traceback.extract_tb(error.__traceback__)[-1]
        ours = "dolfinx_nts/" in where.filename
        wrong = [] if good and ours else [f"names no argument or remedy, {where}"]
        if watch is not None and watch.rows:
            wrong.append(f"raised in mid run, after {len(watch.rows)} rows, {where}")
        said = re.sub("0x[0-9a-f]+", "", repr(error))
        return Verdict("refused", said, wrong)
    except Exception as error:  # any: what a user must not see
        return Verdict("crashed", repr(error), traceback.format_tb(error.__traceback__)[-3:])
    finally:
        if system is not None:
            system.destroy()
    wrong = watch.wrong()
    if scene.nonsense not in ("", "rtol", "max_iterations") and watch.asked(scene.nonsense):
        wrong.append(f"{scene.nonsense} was accepted")
    outcome = "completed" if run.status.startswith("completed") else "stopped"
    if outcome == "stopped" and (
        len(run.status) < 40 or "output[" in run.status or not REMEDY.search(run.status)
    ):
        wrong.append(f"no sentence, or none with a remedy: {run.status}")
    touched = bool(run.balance["active"].any())
    return Verdict(outcome, f"{run.status} {run.warnings}", wrong, touched)


class Watch:
    """A writer that keeps places and velocities of all nodes of each step.

    Args:
        made: The scene.
        comm: MPI communicator.
    """

    def __init__(self, made, comm):
        self.made, self.comm, self.rows, self.run = made, comm, [], None
        self.nodes, self._told = [], set()
        for body, solid in zip(made.system.bodies, made.solids, strict=True):
            owned = body.space.dofmap.index_map.size_local
            x = body.space.tabulate_dof_coordinates()[:owned]
            self.nodes.append((owned, cKDTree(solid.x).query(x)[1]))

    def start(self, stepper):
        self.run = stepper.solution
        self._note()

    def write(self, stepper, *, last=False):
        self._note()

    def close(self, stepper):
        pass

    def _note(self):
        row = []
        for body, solid, (owned, index) in zip(
            self.made.system.bodies, self.made.solids, self.nodes, strict=True
        ):
            both = np.zeros((2, *solid.x.shape))
            for k, function in enumerate((body.u, body.v)):
                both[k, index] = function.x.array[: 3 * owned].reshape(-1, 3)
            both = self.comm.allreduce(both)
            row.append((solid.x + both[0], both[1]))
        self.rows.append(row)
        self._hear()

    def _hear(self):
        """Keep what is told: of a kind and a pair the run keeps the worst alone."""
        self._told |= {(w.kind, w.text) for w in self.run.warnings.every}

    def _is_told(self, kinds, *names):
        """Whether a warning of such a kind names these bodies."""
        return any(kind in kinds and all(n in text for n in names) for kind, text in self._told)

    def asked(self, nonsense):
        """Whether a spoilt argument has reached the package in this scene."""
        scene = self.made.scene
        flexible = any(b.law for b in scene.bodies)
        return {
            "young": flexible, "poisson": flexible,
            "velocity": any(b.law or not b.held for b in scene.bodies),
            "friction": bool(self.made.system.contacts),
            "marker": bool(self.made.system.contacts),
            "smoothing": bool(scene.contacts),
        }.get(nonsense, True)  # fmt: skip

    # ---- what must hold of every run, whatever its end
    def wrong(self):
        """Sentences on what is wrong."""
        table = self.run.balance
        if len(self.rows) != len(table["time"]):
            return [f"{len(self.rows)} rows written, {len(table['time'])} in the balance"]
        if not all(np.isfinite(a).all() for row in self.rows for both in row for a in both):
            return ["positions or velocities are not finite"]
        return [*self._energies(table), *self._momenta(table), *self._ledger(table),
                *self._cells(), *self._overlaps()]  # fmt: skip

    @property
    def _promise(self):
        options = dict(self.made.scene.options)
        rtol = dict(self.made.scene.newton).get("rtol", 1e-12)
        return max(10.0 * rtol, PROMISED[options.get("accuracy", "exact")])

    @property
    def _scene(self):
        return self.made.scene

    @property
    def _mass(self):
        solids = zip(self._scene.bodies, self.made.solids, strict=True)
        return sum(b.density * s.mass.sum() for b, s in solids)

    @property
    def _speed(self):
        return max(np.abs(v).max() for row in self.rows for _, v in row)

    @cached_property
    def _mechanics(self):
        """Of each row kinetic and stored energy, momentum, angular momentum, centre times mass."""
        rows = []
        for row in self.rows:
            total = [0.0, 0.0, np.zeros(3), np.zeros(3), np.zeros(3)]
            for body, solid, (y, v) in zip(
                self._scene.bodies, self.made.solids, row, strict=True
            ):
                mass = body.density * solid.mass
                mv = mass @ v
                total[0] += 0.5 * float((mv * v).sum())
                total[1] += solid.energy(y, law_of(body, self._scene.unit)) if body.law else 0.0
                total[2] += mv.sum(axis=0)
                total[3] += np.cross(y, mv).sum(axis=0)
                total[4] += (mass @ y).sum(axis=0)
            rows.append(total)
        return [np.array(a) for a in zip(*rows, strict=True)]

    def _energies(self, table):
        """Kinetic and stored energy of the balance are those of the nodes."""
        kinetic, stored, momentum, angular, _ = self._mechanics
        largest = max(np.abs(table["energy"]).max(), kinetic.max(), stored.max(), 1e-300)
        massless = any(c.mass == "redistributed" for c in self._scene.contacts)
        stores = any(kind == "Spring" for kind, _, _ in self._scene.joints)
        # A W(C) is rounded at C = 1.
        stiff = 1e-6 * self._scene.unit**2 * sum(b.young * s.mass.sum() for b, s in
                           zip(self._scene.bodies, self.made.solids, strict=True))  # fmt: skip
        checks = [("kinetic", kinetic, largest, massless),
                  ("potential", stored, largest + stiff, stores)]  # fmt: skip
        mass, speed = self._mass, self._speed
        size = max(np.abs(y).max() for row in self.rows for y, _ in row)
        checks += [("linear_momentum", momentum, mass * speed, massless),
                   ("angular_momentum", angular, mass * speed * size, massless)]  # fmt: skip
        for name, own, scale, other in checks:
            off = np.abs(table[name] - own).max()
            if not other and off > 1e-8 * scale + 1e-290:
                yield f"{name} of the balance is off by {off:.3g} of {scale:.3g}"

    def _momenta(self, table):
        """Without anything from outside momenta stay, but for gravity's impulse."""
        scene = self._scene
        grounded = any(g or k + 1 == len(scene.bodies) for _, k, g in scene.joints)
        if scene.floor or grounded or any(b.held for b in scene.bodies):
            return
        mass, speed = self._mass, self._speed
        size = max(np.abs(y).max() for row in self.rows for y, _ in row)
        fall = -scene.unit * scene.gravity * np.outer(table["time"], scene.row)
        expected = table["linear_momentum"][0] + mass * fall
        off = np.abs(table["linear_momentum"] - expected).max()
        scale = max(mass * speed, np.abs(mass * fall).max(), 1e-9 * mass * scene.unit)
        loose = max(1e-9, 1e3 * self._promise)
        if off > loose * scale:
            yield f"linear momentum changes by {off:.3g} of {scale:.3g}"
        fallen = self._mechanics[4] @ np.array(scene.row)
        work = scene.unit * scene.gravity * (fallen[0] - fallen)
        off, whole = np.abs(table["external_work"] - work).max(), np.abs(table["energy"]).max()
        if off > 1e-8 * max(whole, np.abs(work).max(), 1e-9 * mass * scene.unit**2):
            yield f"external work is off from gravity's by {off:.3g} of {whole:.3g}"
        keeps = RULES[scene.rule].keeps_angular_momentum and not scene.gravity
        off = np.abs(table["angular_momentum"] - table["angular_momentum"][0]).max()
        if keeps and off > loose * scale * size:
            yield f"angular momentum changes by {off:.3g} of {scale * size:.3g}"

    def _ledger(self, table):
        """The ledger is closed, or there is a word; nor does energy come from nowhere."""
        names = ("kinetic", "potential", "external_work", "friction_dissipation")
        largest = max(np.abs(table[name]).max() for name in names)
        residual = (
            table["energy"] - table["energy"][0] - table["external_work"]
            - table["impact_restored"] - table["material_change"] - table["interference_work"]
            + table["friction_dissipation"] + table["contact_defect"] + table["massless_defect"]
        )  # fmt: skip
        damped = any(kind == "Damper" for kind, _, _ in self._scene.joints)
        if damped:
            residual = residual + table["damping_dissipation"]
        if np.abs(residual - table["ledger_residual"]).max() > 1e-12 * largest:
            yield "the ledger's residual is not the sum of its columns"
        told = set(self.run.warnings)
        closes = RULES[self._scene.rule].closes_ledger
        missing = np.abs(residual).max()
        # Forces that stop all in a step, and those that hold it, do work over the rounding of
        # positions.
        size = max(np.abs(y).max() for row in self.rows for y, _ in row)
        stops = self._speed / np.diff(table["time"]).min(initial=np.inf)
        holds = self._scene.unit * self._scene.gravity
        rounding = 100.0 * EPS * self._mass * (stops + holds) * size
        allowed = 2.0 * self._promise * largest + rounding
        if closes and missing > allowed and "ledger" not in told:
            yield f"the ledger misses {missing / largest:.3g} of the largest energy"
        if (np.diff(table["friction_dissipation"]) < -1e-9 * largest).any():
            yield "friction gives energy back"
        gain = (table["energy"] - table["energy"][0] - table["external_work"]).max()
        if gain > GAIN * largest + rounding and not told & {"ledger", "energy from behind facets",
                                                 "energy from massless nodes"}:  # fmt: skip
            yield f"energy grows by {gain / largest:.3g} of the largest without a word"

    def _cells(self):
        """No cell ends inside out without a word; hexahedra by their corners."""
        for body, solid, k in zip(self._scene.bodies, self.made.solids, range(9), strict=False):
            end = self.rows[-1][k][0]
            corners = solid.cells if body.cell == "tetrahedron" else solid.cells[:, CORNER_TETS]
            before, after = (
                np.linalg.det(x[corners][..., 1:, :] - x[corners][..., :1, :])
                for x in (solid.x, end)
            )
            if (after * before <= 0.0).any() and "inversion" not in self.run.warnings:
                yield f"cells of body {k} are inside out"

    def _overlaps(self):
        """No body is deep in another one that it is in contact with, nor in the floor."""
        self._hear()
        solids = self.made.solids
        if self._scene.floor is not None and not self._is_told(IN_OBSTACLES, "body 0"):
            depth = max(self._depth_in_floor(k) for k in range(len(self.rows)))
            if depth > DEEP * solids[0].edge:
                yield f"body 0 is {depth:.3g} m inside the {self._scene.floor.kind}"
        for contact in self._scene.contacts:
            pair = (contact.first, contact.first + 1)
            if self._is_told(OVERLAPS, *(f"body {k}" for k in pair)):
                continue
            for a, b in (pair, pair[::-1]):
                allowed = DEEP * min(max(solids[a].edge, solids[b].edge), thickness(solids[b]))
                depth, at, length = self._deepest(a, b)
                # A ring that comes with its axis ahead is as thick as it is long.
                thick = max(thickness(solids[a]), min(shortest(solids[a]), length))
                if depth > min(allowed, DEEP * thick):
                    yield f"body {a} is {depth:.3g} m inside body {b} (row {at:.2f})"

    def _depth_in_floor(self, k):
        """Of nodes of body 0's boundary that began outside, in the k-th row [m]."""
        floor, nodes = self.made.system.contacts[-1].master, np.unique(self.made.solids[0].boundary)

        def gap(k):
            at = 0.0 if floor.motion is None else floor.motion(self.run.balance["time"][k])
            x = self.rows[k][0][0][nodes] - at
            if self._scene.floor.kind == "plane":
                return (x - floor.point) @ floor.normal
            if hasattr(floor, "centre"):
                away = x - floor.centre
            else:
                axis = np.array(floor.axis) / np.linalg.norm(floor.axis)
                away = x - floor.point
                away = away - np.outer(away @ axis, axis)
            return (np.linalg.norm(away, axis=1) - floor.radius) * (-1 if floor.inside else 1)

        return np.max(-gap(k), where=gap(0) >= -1e-9 * self._scene.unit, initial=0.0)

    def _deepest(self, a, b):
        """How deep samples of body a come into body b on straight ways between the rows [m].

        Also in which row, and how long body a is along the shortest way out of b there [m].
        """
        deepest, where, length = 0.0, 0, 0.0
        sa, sb = self.made.solids[a], self.made.solids[b]
        for k, (before, after) in enumerate(zip(self.rows, self.rows[1:], strict=False)):
            ways = [after[j][0] - before[j][0] for j in (a, b)]
            way = np.linalg.norm(ways[0], axis=1).max() + np.linalg.norm(ways[1], axis=1).max()
            parts = min(8, 1 + int(4.0 * way / thickness(sb)))
            for part in np.arange(1, parts + 1) / parts:
                y, z = (before[j][0] + part * w for j, w in zip((a, b), ways, strict=True))
                samples = sa.samples(y)
                depths = sb.depth(z, samples)
                if depths.max() > deepest:
                    deepest, where = depths.max(), k + part
                    length = reach(sa, y, samples[depths.argmax()], sb, z)
        return deepest, where, length


def law_of(body, unit=1.0):
    """Strain energy W(C) of a body [J/m^3] in NumPy, C of shape (..., 3, 3)."""
    mu = unit**2 * body.young / (2 * (1 + body.poisson))
    lame = 2 * mu * body.poisson / (1 - 2 * body.poisson)

    def energy(c):
        if body.law == "neo-Hookean":
            log = np.log(np.linalg.det(c))
            return mu / 2 * (np.trace(c, axis1=-2, axis2=-1) - 3 - log) + lame / 8 * log**2
        e = (c - np.eye(3)) / 2
        return lame / 2 * np.trace(e, axis1=-2, axis2=-1) ** 2 + mu * (e**2).sum((-2, -1))

    return energy


def shortest(solid):
    """Shortest of a body's lengths along its principal axes [m]."""
    middle = solid.x - solid.x.mean(axis=0)
    return float(np.ptp(middle @ np.linalg.eigh(middle.T @ middle)[1], axis=0).min())


def reach(solid, y, point, other, z):
    """How long a body is from a point of its boundary on along the shortest way out of another [m].

    Args:
        solid: The body.
        y: Where its nodes are [m].
        point: On its boundary, inside the other [m].
        other: The other body.
        z: Where its nodes are [m].
    """
    aside = 1e-4 * other.edge * np.concatenate([np.eye(3), -np.eye(3)])
    depth = other.depth(z, point + aside)
    way = depth[3:] - depth[:3]
    way /= max(np.linalg.norm(way), np.finfo(float).tiny)
    middles = y[solid.tets].mean(axis=1)
    inner = middles[np.linalg.norm(middles - point, axis=1).argmin()]
    steps = np.linspace(0.0, np.linalg.norm(np.ptp(y, axis=0)), 400)
    on = solid.inside(y, point + 0.01 * (inner - point) + steps[:, None] * way)
    return float(steps[on.argmin()])


def thickness(solid):
    """Shortest of a body's lengths along its principal axes [m], or a ring's wall.

    A wall is twice as thick as what lies deepest in it, which is looked for at places along the
    edges and diagonals of the cells.
    """
    middle = solid.x - solid.x.mean(axis=0)
    wall = solid.x[solid.tets].mean(axis=1) - solid.x.mean(axis=0)
    if np.linalg.norm(wall, axis=1).min() <= 0.5 * np.linalg.norm(middle, axis=1).max():
        return shortest(solid)
    ends = solid.x[np.unique(np.sort(solid.tets[:, PAIRS].reshape(-1, 2), axis=1), axis=0)]
    parts = np.linspace(0.0, 1.0, 41)[1:-1, None, None]
    places = (ends[:, 0] + parts * (ends[:, 1] - ends[:, 0])).reshape(-1, 3)
    return 2.0 * float(solid.depth(solid.x, places).max())


def judge_restart(scene, comm, path):
    """Judge whether a scene that goes on from a checkpoint in mid run ends as it did without.

    Collective. In serial to the bit; else to 1e-9 of the largest motion, with kept matrices to
    1e-3, and to rounding of the places and velocities themselves, which is all that changes of a
    body that flies free. A scene that is refused says nothing.

    Args:
        scene: The scene.
        comm: MPI communicator.
        path: Of the checkpoint.
    """
    saves = nts.Checkpoint(path, every=scene.steps // 2 + 1)
    try:
        made = built(scene, comm)
        first = Watch(made, comm)
        whole = nts.simulate(made.system, output=[first], checkpoint=saves, **made.run)
    except (TypeError, ValueError) as error:
        return Verdict("refused", repr(error), [])
    middle = previous(path)
    # Where Newton's method fails depends on rounding, as of what the linear solver went over to.
    if not (middle.is_file() and whole.status.startswith("completed")):
        made.system.destroy()
        return Verdict("stopped", whole.status, [])
    again = built(scene, comm)
    second = Watch(again, comm)
    start = nts.restart(middle, again.system)
    if start.state.time >= whole.state.time:
        return Verdict("stopped", whole.status, [])
    given = {k: v for k, v in again.run.items() if k != "project_start"}
    found = nts.simulate(again.system, output=[second], start=start, **given)
    made.system.destroy()
    again.system.destroy()
    exact = dict(scene.options).get("accuracy", "exact") == "exact"
    reuses = dict(scene.newton).get("reuse") or not exact
    loose = 0.0 if comm.size == 1 else (1e-3 if reuses else 1e-9)
    wrong = []
    rows = len(whole.rows) - len(found.rows)
    if rows:
        wrong.append(f"{rows} rows of the balance are lost")
    motions = [np.array([row[k][j] for row in first.rows]) for j in (0, 1)
               for k in range(len(made.solids))]  # fmt: skip
    ends = [[np.array(row[k][j]) for j in (0, 1) for k in range(len(made.solids))]
            for row in (first.rows[-1], second.rows[-1])]  # fmt: skip
    for a, b, motion in zip(*ends, motions, strict=True):
        size, off = np.ptp(motion, axis=0).max(), np.abs(a - b).max()
        if off > (loose and loose * size + 100.0 * EPS * np.abs(motion).max()):
            wrong.append(f"differs by {off:.3g} of {size:.3g}")
    # A restart looks for overlaps at once, so that it may find more of them.
    lost = {k for k in whole.warnings if k not in found.warnings}
    more = {k for k in found.warnings if k not in whole.warnings} - OVERLAPS - IN_OBSTACLES
    if (comm.size == 1 or not reuses) and (lost or more):
        wrong.append(f"warns otherwise: {found.warnings}")
    if not found.status.startswith("completed"):
        wrong.append(f"ends otherwise: {found.status}")
    touched = bool(whole.balance["active"].any())
    return Verdict("completed", f"{whole.status} {whole.warnings}", wrong, touched)
