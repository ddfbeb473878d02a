"""Distorted cells, bars that bend and derivatives by differences, for cells that must not lock."""

from mpi4py import MPI

import numpy as np
import ufl
from measures import STENCIL
from scenes import box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
#: What Q2/P1 elements give on a fine mesh; Euler and Bernoulli's deflection of the bar is 4000.
DEFLECTION = {0.3: 4001.1, 0.4999: 3938.4, 0.499999: 3938.4}


def largest(x):
    return COMM.allreduce(float(np.abs(x).max(initial=0.0)), op=MPI.MAX)


def bar(cells, poisson, metre=1.0, **options):
    """Deflection of a bar under a small load at its end, over load and length."""
    mesh = box(np.zeros(3), metre * np.array([10.0, 1.0, 1.0]), cells)
    load, end = 1e-6, 10.0 * metre * (1 - 1e-9)
    body = nts.Continuum(
        mesh, nts.NeoHookean(young=1.0, poisson=poisson), density=1.0,
        bcs=[nts.Dirichlet(lambda x: x[0] < 1e-9 * metre)],
        traction=[nts.Traction(lambda x: x[0] > end, (0.0, 0.0, load))], **options,
    )  # fmt: skip
    assert nts.equilibrium(nts.System([body])).status == "completed"
    owned = body.reference.reshape(-1, 3)[:, 0] > end
    return largest(body.u.x.array[: body.num_owned].reshape(-1, 3)[owned, 2]) / load / metre


def distorted():
    mesh = box((0.0, 0.0, 0.0), (2.0, 1.0, 1.2), (2, 1, 1), comm=MPI.COMM_SELF)
    x = mesh.geometry.x
    x += 0.08 * np.sin(5.0 * x[:, [1, 2, 0]])
    return mesh


def own_energy(c):
    """A Mooney and Rivlin material as a plain function of C."""
    i3 = ufl.det(c)
    return 0.2 * ufl.tr(c) + 0.1 * ufl.tr(ufl.cofac(c)) - 0.4 * ufl.ln(i3) + 2.0 * (i3 - 1) ** 2


def between(body, seed=0):
    rng = np.random.default_rng(seed)
    return 0.06 * rng.standard_normal((2, body.num_owned))


def differences(function, x, step=1e-3):
    """Derivatives of an array's function by finite differences, as columns."""
    columns = []
    for e in step * np.eye(len(x)):
        columns.append(sum(w * function(x + k * e) for k, w in STENCIL) / step)
    return np.array(columns).T
