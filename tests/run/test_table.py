"""What a run keeps of its steps: right, in little memory, and safe from those who read it."""

import gc
import sys
import tracemalloc
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts
from dolfinx_nts.ledger.balance import COLUMNS, Switch, Switches
from dolfinx_nts.run.record import Table
from dolfinx_nts.run.solution import Solution

COMM = MPI.COMM_WORLD


def rows(n):
    return [{"a": 0.5 * k, "v": np.array([k, -k, 1.0]), "w": np.zeros((0, 3))} for k in range(n)]


@pytest.mark.parametrize("n", [1, 16, 17, 1000])
def test_a_table_holds_its_rows(n):
    expected, table = rows(n), Table()
    for row in expected:
        table.append(row)
    assert len(table) == n and len(list(table)) == n
    for k in {0, n // 2, n - 1, -1, -n}:
        assert table[k]["a"] == expected[k]["a"] and isinstance(table[k]["a"], float)
        assert np.array_equal(table[k]["v"], expected[k]["v"])
    assert [r["a"] for r in table[-3:]] == [r["a"] for r in expected[-3:]]
    assert np.array_equal(table.column("a"), 0.5 * np.arange(n))
    assert table.column("v").shape == (n, 3) and table.column("w").shape == (n, 0, 3)
    for k in (n, -n - 1):
        with pytest.raises(IndexError):
            table[k]


def test_a_reader_cannot_change_a_table():
    table = Table(rows(20))
    column = table.column("v")
    with pytest.raises(ValueError, match="read-only"):
        column[3] = 7.0
    row = table[3]
    row["a"], row["v"][:] = 7.0, 7.0
    assert table[3]["a"] == 1.5 and np.array_equal(table[3]["v"], [3.0, -3.0, 1.0])
    for row in rows(1000):
        table.append(row)
    assert column.shape == (20, 3) and np.array_equal(column[:, 0], np.arange(20))
    assert len(table.column("v")) == 1020


def test_switches_keep_the_newest_and_the_sums():
    rng = np.random.default_rng(0)
    defects, switches = rng.normal(size=3 * Switches.KEPT), Switches()
    every = [Switch(0.1 * k, "c", k, (0, 1), float(d)) for k, d in enumerate(defects)]
    for part in np.split(np.arange(len(every)), 300):
        switches.extend(every[k] for k in part)
    assert len(switches) == Switches.KEPT and list(switches) == every[-Switches.KEPT :]
    assert switches[-1] is every[-1] and switches[:2] == every[-Switches.KEPT :][:2]
    assert switches.number == len(every)
    assert switches.defect == pytest.approx(defects.sum(), rel=1e-11)
    assert switches.size == pytest.approx(np.abs(defects).sum(), rel=1e-11)
    assert switches.worst is every[int(np.abs(defects).argmax())]


def test_summary_says_what_changes_of_facet_cost():
    """A sum of -6 J in absolute values of 4 J on average."""
    table = Table([dict.fromkeys(COLUMNS, 0.0)])
    run = Solution(SimpleNamespace(joints=()), rows=table)
    run.switches.extend(Switch(0.1, "c", 1, (2, 3), d) for d in (-8.0, 3.0, -1.0))
    line = "3 changes of facet: contact defect -6 in all, mean of absolute values 4; most -8"
    assert line in run.summary


@pytest.mark.slow
def test_memory_of_a_long_run():
    """Columns of 8 B a number, with a quarter more room, and nothing else.

    Half a row more at most: the room is a quarter more than the rows at the end, and none at the
    start, and Python's own free lists hold some kB. A row of Python's floats would be four times as
    much.
    """
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
    rubber = nts.StVenantKirchhoff(1e6, 0.3)
    body = nts.Continuum(mesh, rubber, density=1e3, velocity=(0.1, 0, 0), name="body")
    stepper, steps = nts.Stepper(nts.System([body]), nts.EnergyMomentum()), 600
    # Under way already: what replaces an object that is not traced would count as more.
    tracemalloc.start()
    for _ in range(200):
        stepper.advance(1e-3)
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(steps):
        stepper.advance(1e-3)
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    stepper.close()
    assert stepper.solution.rows[-1]["time"] == pytest.approx(0.8)
    numbers = sum(np.size(value) for value in stepper.solution.rows[-1].values())
    assert grown < 1.5 * 8 * numbers * steps


@pytest.mark.slow
@pytest.mark.parametrize("meshed", [False, True])
def test_memory_of_a_long_run_in_contact(meshed):
    """Columns of 8 B a number, also those of the contact's force and moment, and no objects.

    A row of Python's own floats would be 20 blocks of memory and more.
    """
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
    rubber = nts.StVenantKirchhoff(1e6, 0.3)
    body = nts.Continuum(mesh, rubber, density=1e3, velocity=(0.1, 0, 0), name="body")
    bodies, master = [body], nts.Plane((0, 0, 0), (0, 0, 1))
    if meshed:
        held = nts.Dirichlet(lambda x: x[2] < 9)
        mesh = create_box(COMM, [[-1, -1, -1], [3, 3, 0]], [2, 2, 1], CellType.hexahedron)
        bodies.append(nts.Continuum(mesh, rubber, density=1e3, bcs=[held], name="floor"))
        master = bodies[1].surface(lambda x: x[2] > -1e-9)
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), master, friction=0.01)
    system = nts.System(bodies, contacts=[pair], gravity=(0, 0, -9.81))
    stepper, blocks, steps = nts.Stepper(system, nts.EnergyMomentum()), [], 60
    for _ in range(3):
        for _ in range(steps):
            stepper.advance(1e-4)
        gc.collect()
        blocks.append(sys.getallocatedblocks())
    stepper.close()
    run = stepper.solution
    assert np.count_nonzero(run.balance["active"]) > steps
    assert blocks[2] - blocks[1] < 2 * steps
    tables = *run.balance.values(), run.contact_forces, run.contact_moments
    assert sum(column.nbytes for column in tables) < 310 * len(run.rows)
