"""Ways to treat an impact that the package does not have, on a linear bar in one dimension.

    python benchmarks/impacts_1d.py

The bar of `demos/bar_impact.py` hits the wall, Courant number 1, with the gap closing anywhere in a
step. Beside the published scheme and massless nodes: a constraint on velocities (Moreau and Jean),
which lets no velocity into the wall once the gap at the middle of a step is closed, with
restitution e; and forces that are the mean of two steps though the node keeps its mass.
"""

import numpy as np

LENGTH, YOUNG, DENSITY, SPEED, WAVE = 10.0, 900.0, 1.0, 1e-2, 30.0
WAYS = ("published", "velocity, e = 0", "velocity, e = 1", "averaged", "massless")


def bar(elements, massless):
    """Mass and stiffness; a massless first node hands its mass on, see `bodies/solid/massless`."""
    dx, n = LENGTH / elements, elements + 1
    mass, stiffness = np.zeros((n, n)), np.zeros((n, n))
    for e in range(elements):
        at = np.ix_([e, e + 1], [e, e + 1])
        mass[at] += DENSITY * dx / 6 * np.array([[2, 1], [1, 2]])
        stiffness[at] += YOUNG / dx * np.array([[1, -1], [-1, 1]])
    if not massless:
        return mass, stiffness
    x, one, handed, a = np.linspace(-1, 1, n), np.ones(n), np.eye(n), np.zeros(3)
    handed[0, :2] = 0, 1
    less, shape, pairs = handed.T @ mass @ handed, np.vander(x, 3), ((one, one), (x, one), (x, x))
    for _ in range(20):
        f = 1 + shape @ a
        new = less * f * f[:, None]
        slope = [
            [p @ (less * (s[:, None] * f + f[:, None] * s)) @ q for s in shape.T] for p, q in pairs
        ]
        a -= np.linalg.solve(slope, [p @ (new - mass) @ q for p, q in pairs])
    return new, stiffness


def impact(way, elements, closing):
    """Part of the energy lost, rms of the force over the exact one less 1, gap over a step's way.

    Args:
        way: One of `WAYS`.
        elements: Of the bar.
        closing: Part of a step that is left when the gap closes.
    """
    mass, stiffness = bar(elements, way == "massless")
    dt = LENGTH / elements / WAVE
    gap0, n = (10 - closing) * dt * SPEED, elements + 1
    inverse = np.linalg.inv(mass + dt**2 / 4 * stiffness)
    push = dt**2 / 2 * inverse[:, 0]
    u, v, before, rows = np.zeros(n), np.full(n, -SPEED), 0.0, []
    for k in range(round((gap0 / SPEED + 1.0) / dt)):
        u1 = inverse @ (mass @ (u + dt * v) - dt**2 / 4 * stiffness @ u)
        if way.startswith("velocity"):
            closed = gap0 + u[0] + dt / 2 * v[0] <= 1e-12 * gap0
            speed = 2 * (u1[0] - u[0]) / dt - v[0] + float(way[-1]) * v[0]
            force = max(0.0, -speed * dt / 2 / push[0]) if closed else 0.0
            u1 += force * push
        elif way == "published":
            force = max(0.0, -(gap0 + u1[0]) / push[0])
            u1 += force * push
        else:
            u1 += before / 2 * push
            end = max(0.0, -(gap0 + u1[0]) / push[0] * 2)
            u1 += end / 2 * push
            force, before = end if way == "massless" else (end + before) / 2, end
        v, u = 2 * (u1 - u) / dt - v, u1
        rows.append(((k + 1) * dt - gap0 / SPEED, force, gap0 + u[0]))
    time, force, gap = np.array(rows).T
    inside = (time > 2.5 * dt) & (time < 2 * LENGTH / WAVE - 2.5 * dt)
    energy = 0.5 * (v @ mass @ v + u @ stiffness @ u) / (0.5 * DENSITY * LENGTH * SPEED**2)
    exact = DENSITY * WAVE * SPEED
    rms = float(np.sqrt(np.mean((force[inside] / exact - 1.0) ** 2)))
    return float(1 - energy), rms, float(gap.min() / (SPEED * dt))


def main(elements=(50, 100)):
    """Print a table and return {(way, elements): rows of `impact`}."""
    results = {}
    print(f"{'way':16}{'n':>5}{'lost, mean':>12}{'rms of force':>18}{'deepest':>9}")
    for way in WAYS:
        for n in elements:
            rows = np.array([impact(way, n, closing) for closing in (0.0, 0.25, 0.5, 0.75)])
            (lost, _, _), (_, least, deep), (_, most, _) = rows.mean(0), rows.min(0), rows.max(0)
            print(f"{way:16}{n:5}{lost:12.1e}{least:9.3f} to {most:5.3f}{deep:9.2f}")
            results[way, n] = rows
    return results


if __name__ == "__main__":
    main()
