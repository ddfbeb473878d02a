"""Plots of the balance table: energies, ledger and momenta over time, of one or several runs."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.ledger import balance as ledger
from dolfinx_nts.output.whole_files import replace_file
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StrPath

Balance = Mapping[str, FloatArray]


class _Panel(NamedTuple):
    """One plot; with `floor`, absolute values on a logarithmic axis, from that value upwards.

    It is `idle` where there is nothing to be plotted, as without contacts or in equilibrium.
    """

    title: str
    unit: str
    lines: dict[str, FloatArray]
    floor: float | None = None
    steps: bool = False
    idle: bool = False


#: Lower end of logarithmic axes relative to what is compared: nothing below means anything.
_ROUND_OFF = 0.1 * float(np.finfo(float).eps)
#: Of the lines of a run where there are several runs.
_STYLES = ("-", "--", ":", "-.")


#: Of a figure; to let matplotlib find them takes as long as to draw it.
_MARGINS = {"left": 0.08, "right": 0.99, "hspace": 0.22, "wspace": 0.2}


def _panels(balance: Balance, several: bool) -> list[_Panel]:
    missing = sorted(set(ledger.COLUMNS) - set(balance))
    if missing:
        raise ValueError(f"balance: columns {missing} are missing; pass Solution.balance")
    if several:
        energy = _Panel("Total energy", "[J]", {"": balance["energy"]})
    else:
        lines = {"total": balance["energy"]} | {n: balance[n] for n in ("kinetic", "potential")}
        energy = _Panel("Energy", "[J]", lines)
    works = (*ledger.WORKS, *ledger.CHANGES)
    scale = float(np.nanmax(np.abs(balance["energy"]), initial=0.0)) or 1.0
    # Without contacts no gap is ever known.
    apart = not (balance["active"].any() or np.isfinite(balance["min_gap"]).any())
    first = "" if apart else "contact_defect"
    work = {
        name.replace("_", " "): balance[name]
        for name in ("contact_defect", *(n for n in works if n != "contact_defect"))
        if name == first or not np.abs(balance[name]).max() <= _ROUND_OFF * scale
    }
    nodes = {
        n: balance[n] for n in ("active", "stick", "slip") if n == "active" or balance[n].any()
    }
    residual = {"": balance["ledger_residual"] / scale}
    panels = [
        energy,
        _Panel("Ledger residual / largest energy", "[-]", residual, _ROUND_OFF),
        _Panel(", ".join(work).capitalize(), "[J]", work, idle=not work),
        _Panel("Slave nodes in contact", "[-]", nodes, steps=True, idle=apart),
    ]
    for name, unit in (("linear", "kg m/s"), ("angular", "kg m²/s")):
        value = balance[f"{name}_momentum"]
        size = float(np.linalg.norm(value, axis=1).max())
        title = f"Change of {name} momentum (of {size:.3g} {unit})"
        change = {"": np.linalg.norm(value - value[0], axis=1)}
        floor = _ROUND_OFF * (size or 1.0)
        panels.append(_Panel(title, f"[{unit}]", change, floor, idle=not size))
    return panels


def plot_balance(balance: Balance, path: StrPath | None = None) -> Any:
    """Plot energies, ledger residual, defect and work, active nodes, momentum changes over time.

    A scene without contacts has no active nodes to plot. Call it on one rank; `Solution.plot` sees
    to that.

    Args:
        balance: `Solution.balance`.
        path: Picture file; its ending chooses the format. None: no file.

    Returns:
        matplotlib's Figure.

    Raises:
        ValueError: Columns are missing.
    """
    return _plot({"": balance}, path)


def compare_balances(balances: Mapping[str, Balance], path: StrPath | None = None) -> Any:
    """Plot several runs together, e.g. both integrators. Call it on one rank.

    Args:
        balances: Label -> `Solution.balance`.
        path: Picture file; its ending chooses the format. None: no file.

    Returns:
        matplotlib's Figure.

    Raises:
        ValueError: No run, or columns are missing.
    """
    if not balances:
        raise ValueError(
            f"balances={balances!r}: pass at least one, as {{label: Solution.balance}}"
        )
    return _plot(balances, path)


def picture_of(figure: Any, dpi: int = 150, kind: str = "png") -> bytes:
    """A figure of matplotlib in the bytes of a picture file."""
    image = io.BytesIO()
    figure.savefig(image, format=kind, dpi=dpi)
    return image.getvalue()


def _plot(balances: Mapping[str, Balance], path: StrPath | None) -> Any:
    from matplotlib.figure import Figure

    runs = [(run, b["time"], _panels(b, len(balances) > 1)) for run, b in balances.items()]
    each = zip(*(panels for *_, panels in runs), strict=True)
    busy = [[panel for panel in alike if not panel.idle] for alike in each]
    shown = [k for k, panels in enumerate(busy) if panels]
    rows = (len(shown) + 1) // 2
    figure = Figure(figsize=(9.5, 2.5 * rows))
    margins = _MARGINS | {"bottom": 0.21 / rows, "top": 1.0 - 0.12 / rows}
    grid = figure.subplots(rows, 2, sharex=True, squeeze=False, gridspec_kw=margins)
    below = [*grid[-1]]
    if len(shown) % 2:
        grid[-1, -1].remove()
        below[-1] = grid[-2, -1]
    for k, axes in zip(shown, grid.T.ravel(), strict=False):
        for r, (run, time, panels) in enumerate(runs):
            _lines(axes, panels[k], time, run, r if len(runs) > 1 else None)
        _style(axes, busy[k][0])
        if any(not line.get_label().startswith("_") for line in axes.lines):
            axes.legend(fontsize=8, frameon=False)
    for axes in below:
        axes.set_xlabel("time [s]", fontsize=9)
        axes.tick_params(labelbottom=True)
    if path is not None:
        save_figure(figure, Path(path), dpi=150)
    return figure


def _lines(axes: Any, panel: _Panel, time: FloatArray, run: str, number: int | None) -> None:
    """Draw a run; of several, the first is the widest so that coinciding ones stay visible."""
    for j, (name, values) in enumerate(panel.lines.items()):
        look: dict[str, Any] = {"color": f"C{j}", "linewidth": 1.4}
        if number is not None:
            look = {"color": f"C{number}", "linestyle": _STYLES[j % len(_STYLES)]}
            look["linewidth"] = max(2.6 - 1.4 * number, 1.2)
        alone = number is not None and len(panel.lines) == 1
        shown = panel.title == "Total energy" if alone else bool(name)
        label = ", ".join(filter(None, (run, "" if alone else name))) if shown else "_"
        where = "steps-post" if panel.steps else "default"
        if panel.floor is not None:
            # The start has no change, which a logarithmic axis cannot show.
            time, values = time[1:], np.maximum(np.abs(values[1:]), panel.floor)
        axes.plot(time, values, drawstyle=where, label=label, **look)


def _style(axes: Any, panel: _Panel) -> None:
    axes.set_title(panel.title, fontsize=10, loc="left")
    axes.set_ylabel(panel.unit, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    if panel.floor is not None:
        axes.set_yscale("log")
        axes.minorticks_off()
        # Whole decades, of which one at least has a number.
        axes.set_ylim(*10.0 ** (np.log10(axes.get_ylim()) + [-0.5, 0.5]).round())


def save_figure(figure: Any, path: Path, **options: Any) -> None:
    """Save a figure of matplotlib, and make its folder; if that fails, an old picture remains."""
    kind, image = path.suffix[1:] or figure.canvas.get_default_filetype(), io.BytesIO()
    figure.savefig(image, format=kind, **options)
    replace_file(path if path.suffix else path.with_name(f"{path.name}.{kind}"), image.getvalue())
