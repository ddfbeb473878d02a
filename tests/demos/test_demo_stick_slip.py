"""A block behind a spring sticks and slips as its closed form says."""

import math

import numpy as np
import stick_slip as demo


def test_closed_form_of_stick_slip_solves_the_equation_of_motion():
    """A rigid block behind the spring, by small explicit steps with Coulomb's law."""
    dt, end = 2e-5, demo.END
    bound, x, v = demo.FRICTION * demo.GRAVITY, 0.0, 0.0
    times, ways = dt * np.arange(int(end / dt)), []
    for t in times:
        ways.append(x)
        pull = demo.FREQUENCY**2 * (demo.spring_end(t) - x)
        # What friction may take from the velocity of this step, at most all of it.
        free = v + dt * pull
        v = math.copysign(max(abs(free) - dt * bound, 0.0), free)
        x += dt * v
    np.testing.assert_allclose(ways, demo.jerky_way(times), rtol=0, atol=2e-3 * demo.JERK)
