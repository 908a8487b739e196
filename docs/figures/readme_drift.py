"""Draw docs/figures/readme_drift.png from the run of a demonstration: readme_drift.py [RUNS]."""

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from errormotion import datasets
from errormotion.twin import Event, VirtualMachine

COLOURS = {"X": "#1f5a96", "Y": "#d9822b", "Z": "#2e8b57"}
GREY = "#8a8f98"
LAYOUT = {
    "displacement": ("EX", "EY", "EZ", 1e6, "µm"),
    "tilt": ("EA", "EB", 180 / np.pi * 3600, "arcsec"),
}


def newest_drift(runs: Path) -> xr.Dataset:
    """Return the errors of the newest drift run in a folder of runs."""
    found = sorted(runs.glob("*-drift-*/errors/*/errors.nc"))
    if not found:
        raise SystemExit(f"No drift run with errors in '{runs}': run 'errormotion demo --runs {runs}' first.")
    return datasets.load(found[-1])


def truth_of(errors: xr.Dataset) -> xr.Dataset:
    """Return what the virtual machine really did, relative to the same state and at the same point."""
    provenance = json.loads(errors.attrs["provenance"])
    events = provenance["settings"]["schedule"]
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(e["at"], spindle_speed=e["spindle_speed"], compensation=e["compensation"]) for e in events])
    reference = errors.attrs["reference_time"]
    truth = machine.truth_spindle(errors.time.values + reference, errors.attrs["functional_point"])
    at_reference = machine.truth_spindle([reference], errors.attrs["functional_point"])
    return truth.assign({name: truth[name] - at_reference[name].values for name in datasets.DOF})


def draw(curve: Axes, rest: Axes, errors: xr.Dataset, truth: xr.Dataset, what: str) -> None:
    """Draw the measured errors over the truth, and below the difference, with the stated uncertainty."""
    *names, scale, unit = LAYOUT[what]
    minutes = errors.time.values / 60
    expanded = errors.em.expanded()
    for name in names:
        colour = COLOURS[{"A": "X", "B": "Y"}.get(name[1], name[1])]
        measured, known = errors[name].values * scale, truth[name].values * scale
        U = expanded.sel(dof=name).values * scale
        curve.plot(minutes, known, color=GREY, lw=3.5, alpha=0.45, solid_capstyle="round")
        curve.plot(minutes, measured, color=colour, lw=1.2)
        curve.text(minutes[-1] + 1.5, measured[-1], name, color=colour, va="center")
        rest.fill_between(minutes, -U, U, color=colour, alpha=0.18, lw=0)
        rest.plot(minutes, measured - known, color=colour, lw=0.6)
    curve.set(title=f"{what.capitalize()} of the spindle", ylabel=unit, xlim=(0, 104))
    rest.set(title="measured minus true, and the stated U (k = 2)", ylabel=unit, xlabel="time in min", xlim=(0, 104))


def main() -> None:
    """Draw and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="?", type=Path, default=Path("runs"), help="folder with the demonstration's runs")
    errors = newest_drift(parser.parse_args().runs).isel(time=slice(None, None, 10))
    truth = truth_of(errors)
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 2, figsize=(10, 5), height_ratios=(2, 1), sharex=True, layout="constrained")
    for column, what in enumerate(LAYOUT):
        draw(*axes[:, column], errors, truth, what)
    axes[0, 0].plot([], [], color=GREY, lw=3.5, alpha=0.45, label="truth of the virtual machine")
    axes[0, 0].plot([], [], color="#444", lw=1.2, label="measured by five sensors")
    axes[0, 0].legend(frameon=False, loc="upper left")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.08)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
