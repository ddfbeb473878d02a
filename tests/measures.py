"""What several test modules measure: differences, derivatives, ledgers, entries of matrices."""

import numpy as np
import pytest

import dolfinx_nts as nts
from dolfinx_nts.run.locking_watch import LockingWatch

#: Offsets and weights of differences that are exact for polynomials up to degree 4, whatever the
#: step.
STENCIL = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
#: What the ledger may miss of the largest energy without a word, by accuracy, where a rule closes
#: it, and where none does (docs/features.md).
PROMISED, OPEN = {"exact": 1e-11, "balanced": 1e-8, "fast": 1e-5}, 1e-2
#: Columns of the balance table that say whether two runs are the same.
COLUMNS = ("kinetic", "potential", "friction_dissipation", "contact_defect", "angular_momentum")


# ---- what a run tells
def kinds(run):
    """Kinds of a run's warnings but those of cells, which are coarse in scenes of tests."""
    return [kind for kind in run.warnings if kind not in LockingWatch.KINDS]


# ---- derivatives and arrays
def differences(function, x, step=1e-3):
    """Return the derivative of a batched function of x (n, m); its last axis is x's component."""
    columns = []
    for e in np.eye(x.shape[1]):
        columns.append(sum(w * function(x + k * step * e) for k, w in STENCIL) / step)
    return np.stack(columns, axis=-1)


def relative(found, expected):
    """Return the largest difference over the largest expected value."""
    return np.abs(found - expected).max() / np.abs(expected).max()


def dense(a):
    """Return all entries of a PETSc matrix."""
    rows, cols = (np.arange(n, dtype=np.int32) for n in a.getSize())
    return a.getValues(rows, cols)


def block_errors(found, expected, blocks):
    """Largest difference of each block over its largest entry; of all entries where it is zero."""
    errors = {}
    for i, rows in enumerate(blocks):
        for j, cols in enumerate(blocks):
            e, f = expected[rows, cols], found[rows, cols]
            scale = np.abs(f if f.any() else found).max(initial=0.0)
            errors[i, j] = np.abs(f - e).max(initial=0.0) / scale
    return errors


def assert_tangent(run, look):
    """The matrix of a step from a run's end is the derivative of its residual, to 1e-6.

    Args:
        run: Of contacts whose nodes partly stick and partly slip.
        look: Is shown the problem of the step and its iterate.
    """
    stepper = nts.Stepper(run.system, nts.EnergyMomentum(), start=run)
    problem = stepper.problem
    problem.begin(stepper.state, 0.5)
    rng, laid = np.random.default_rng(3), problem.laid
    multipliers = laid.of_elements("constraints")
    with problem.x as x:
        x[: multipliers.start] += 1e-4 * rng.normal(size=multipliers.start)
        x[multipliers] *= 1.0 + 0.1 * rng.random(multipliers.stop - multipliers.start)
    at_x = problem.evaluate(problem.x)
    look(problem, at_x)
    for sticks in (True, False):
        assert any((part.active & (part.stick == sticks)).any() for part in at_x.parts)
    stepper.solver.assemble(at_x)
    way, found = problem.x.duplicate(), problem.x.duplicate()
    for here in (slice(0, multipliers.start), multipliers):
        direction = np.zeros(len(at_x.x))
        direction[here] = rng.normal(size=here.stop - here.start)
        direction[laid.held] = 0.0
        # Forces are to motions as the bodies are stiff.
        step = 1e-6 * np.abs(at_x.x[here]).max()
        expected = np.zeros(len(direction))
        for k, w in STENCIL:
            way.array_w[:] = at_x.x + k * step * direction
            expected += w / step * problem.residual(problem.evaluate(way))
        way.array_w[:] = direction
        stepper.solver.matrix.operator.mult(way, found)
        assert relative(found.array_r, expected) < 1e-6
    for vector in (way, found):
        vector.destroy()
    stepper.close()


# ---- balance tables
def difference(a, b):
    """Largest difference of the balance tables, over the energy or the momentum of the scene."""
    worst = 0.0
    for name in COLUMNS:
        scale = a["energy"][0] if a[name].ndim == 1 else np.abs(a[name]).max()
        worst = max(worst, float(np.abs(a[name] - b[name]).max() / scale))
    return worst


def drift(table, name):
    """Range of a column of a balance table over its largest value."""
    return np.ptp(table[name], axis=0).max() / np.abs(table[name]).max()


def ledger_or_word(run, promised=1e-8):
    """Return what the ledger misses of the largest energy; more than `promised` must be told.

    Args:
        run: A run, complete or not.
        promised: Of the integrator and accuracy; OPEN of one that does not close the ledger.
    """
    table, names = run.balance, ("kinetic", "potential", "external_work", "friction_dissipation")
    missing = np.abs(table["ledger_residual"]) / max(np.abs(table[name]).max() for name in names)
    assert missing.max() <= promised or "ledger" in run.warnings
    return missing.max()


# ---- figures of demos
def assert_as_coulomb_says(figures, closed_form):
    """Check figures of a block on a floor, and that friction never gives energy back."""
    for name, exact in closed_form.items():
        if exact:
            assert figures[name] == pytest.approx(exact, rel=1e-3), name
        else:
            assert abs(figures[name]) < 1e-12
    assert figures["status"] == "completed"
    assert figures["least_dissipation"] > -1e-15
    assert figures["iterations"] < 3
