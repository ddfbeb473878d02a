"""Numbers of two systems of units in one scene are told, right ones are not (docs/units.md)."""

import re
from pathlib import Path

import numpy as np
import pytest
from lines import interval_mesh
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.start.units import doubtful_units

PAGE = Path(__file__).parents[2] / "docs/units.md"
#: Each unit of the table in m, kg, s; of an inch and a pound-force by definition.
INCH, POUND = 0.0254, 4.4482216152605
BASE = {
    "m": 1.0, "mm": 1e-3, "um": 1e-6, "in": INCH, "kg": 1.0, "t": 1e3, "g": 1e-3,
    "lbf s²/in": POUND / INCH, "s": 1.0, "ms": 1e-3,
}  # fmt: skip
DERIVED = {
    "N": 1.0, "kN": 1e3, "uN": 1e-6, "lbf": POUND, "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9,
    "psi": POUND / INCH**2, "J": 1.0, "kJ": 1e3, "mJ": 1e-3, "pJ": 1e-12, "in lbf": POUND * INCH,
}  # fmt: skip


def block(young, density, gravity, size=1.0):
    """A cube of steel or rubber of one cell."""
    law = nts.NeoHookean(young=young, poisson=0.3)
    body = nts.Continuum(box(high=(size,) * 3, cells=1), law, density=density, name="part")
    return nts.System([body], gravity=(0, 0.6 * gravity, -0.8 * gravity))


def test_the_table_is_consistent_and_right_scenes_are_silent():
    lines = [line.strip("|").split("|") for line in PAGE.read_text().splitlines()]
    rows = [[c.strip() for c in cells] for cells in lines if len(cells) == 7]
    rows = [row for row in rows if re.match(r"\d", row[2])]
    assert len(rows) == 7
    for base, derived, *numbers in rows:
        length, mass, time = (BASE[name] for name in base.split(", "))
        force = mass * length / time**2
        stress = force / length**2
        found = [DERIVED[name] for name in derived.split(", ")]
        np.testing.assert_allclose(found, [force, stress, force * length], rtol=1e-12)
        density, young, gravity, speed, viscosity = map(float, numbers)
        si = [density * mass / length**3, young * stress, gravity * length / time**2,
              speed * length / time, viscosity * stress * time]  # fmt: skip
        np.testing.assert_allclose(si, [7800.0, 2.1e11, 9.81, 1.0, 1.0], rtol=5e-3)
        assert not list(doubtful_units(block(young, density, gravity, 0.1 / length), in_time=True))


def test_a_wave_speed_that_no_material_has_is_told():
    """By sqrt(3 mu/rho), of stretches without change of volume."""
    for young, density, gravity, unit, limit in (
        (2.1e11, 7.8, 9.81, 1.0, 2.5e4),  # t/m^3 with Pa
        (210.0, 7800.0, 9.81, 1.0, 0.2),  # GPa with kg/m^3
        (2.1e5, 7.8e-9, 9.81, 1.0, 2.5e4),  # gravity of metres in mm and t
        (2.1e5, 7800.0, 9810.0, 1e-3, 0.2),  # kg/m^3 in mm and MPa
    ):
        ((name, size, text),) = doubtful_units(block(young, density, gravity), in_time=True)
        wave = np.sqrt(3.0 * young / 2.6 / density) * unit
        assert size == pytest.approx(max(wave / limit, limit / wave), rel=1e-6)
        assert name == "part" and f"is {wave:.2g} m/s" in text


def test_a_body_that_its_weight_crushes_is_told_whatever_the_gravity():
    ((_, size, text),) = doubtful_units(block(210.0, 7800.0, 1.62, size=2.0), in_time=False)
    # The diagonal of 0.6 and 0.8 through a cube is 1.4 of its edge.
    weight = 7800.0 * 1.62 * 1.4 * 2.0 / (3.0 * 210.0 / 2.6)
    assert size == pytest.approx(weight / 10.0, rel=1e-6) and f"is {weight:.2g} times" in text


def test_a_beam_is_told_by_its_axis():
    """Waves of sqrt(EA/rhoA): stretched along its axis by 1, which lies along a coordinate's."""
    section = nts.Rectangle(0.02, 0.02).section(young=2e5, poisson=0.3, density=7800.0)
    x = np.linspace(0, 1, 3)[:, None] * [1.0, 0.0, 0.0]
    beam = nts.Beam(interval_mesh(x), section, name="part")
    system = nts.System([beam], gravity=(0, 0, -9.81e6))
    ((_, size, _),) = doubtful_units(system, in_time=False)
    assert size == pytest.approx(0.2 / (np.sqrt(2e5 / 7800.0) * 1e-6), rel=1e-3)


@pytest.mark.mpi
def test_a_run_and_an_equilibrium_tell_it():
    """In statics a body without weight is no mistake."""

    def scene(young, density):
        clamp, steel = nts.Dirichlet(lambda x: x[2] < 1e-9), nts.NeoHookean(young, poisson=0.3)
        body = nts.Continuum(box(cells=1), steel, density=density, bcs=[clamp], name="part")
        return nts.System([body], gravity=(0, 0, -9.81))

    run = nts.simulate(scene(2.1e11, 7.8), nts.EnergyMomentum(), dt=1e-3, t_end=1e-3)
    assert run.status == "completed" and list(run.warnings) == ["units"]
    assert "more than any material has" in run.warnings["units"].text
    assert not nts.equilibrium(scene(2.1e11, 7.8)).warnings
    soft = nts.equilibrium(scene(210.0, 7800.0), load_steps=[1e-5])
    assert "less than any material has" in soft.warnings["units"].text


def test_limits_in_degrees_are_told():
    for limits, told in (((-90, 30), True), ((-1.5, 0.5), False), ((-7.25, 8.5), False)):
        arm = nts.RigidBody.from_inertia(1.0, (1, 1, 1), name="arm")
        hinge = nts.Revolute(
            arm, None, point=(0, 0, 0), axis=(0, 0, 1), limits=limits, name="hinge"
        )
        found = list(doubtful_units(nts.System([arm], joints=[hinge]), in_time=True))
        assert [name for name, *_ in found] == ["hinge limits"] * told
