"""Rounding as another machine would have it: `pytest --noise=KIND --noise-seed=N`.

The kinds are

- `residual`: each entry of a step's residual is off by up to four units in the last place;
- `forces`: each entry of a body's internal force is off by up to the machine precision times the
  largest one of that body;
- `both`.

Noise is a function of the seed and of what it falls on, as rounding is: an evaluation repeated
gives the same bits, and so do a run repeated within one process and one in units that differ by a
power of two.
"""

import zlib

import numpy as np

from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.parallel import global_max

KINDS = ("residual", "forces", "both")
_EPS = float(np.finfo(float).eps)


def _uniform(seed, values):
    key = zlib.crc32(np.frexp(values)[0].tobytes())  # without exponents, which units change
    return np.random.default_rng([seed, key]).uniform(-1.0, 1.0, values.shape)


def install(kind: str, seed: int, change=setattr) -> None:
    """Make all steps of this process noisy, by `change(class, method, function)`."""
    residual, without_elements = StepProblem.residual, StepProblem._without_elements

    def noisy_residual(self, e):
        r = residual(self, e)
        return r + 4 * np.spacing(np.abs(r)) * (r != 0.0) * _uniform(seed, r)

    def noisy_forces(self, k, u1):
        u1, du, internal, external, total = without_elements(self, k, u1)
        top = global_max(self.system.comm, np.array([np.abs(internal).max(initial=0.0)]))[0]
        noise = _EPS * top * _uniform(seed, internal)
        return u1, du, internal + noise, external, total + noise

    if kind in ("residual", "both"):
        change(StepProblem, "residual", noisy_residual)
    if kind in ("forces", "both"):
        change(StepProblem, "_without_elements", noisy_forces)
