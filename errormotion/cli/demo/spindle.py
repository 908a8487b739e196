"""``errormotion demo``: the shipped campaign on a virtual machine, and its result compared with the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.arrays import Array
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.truth import machine_of, truth_of
from errormotion.cli.commands.campaigns.run import describe, work
from errormotion.cli.commands.results.compare import as_plain, text
from errormotion.cli.output import show, show_json, table
from errormotion.compare import compare as compared
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.twists import move
from errormotion.report.document import Source
from errormotion.report.drawings.series import events, steps
from errormotion.report.provenance import read
from errormotion.twin import VirtualMachine

CAMPAIGN = Path(__file__).parent / "campaign.toml"

UM, ARCSEC = (1e6, "um"), (648000 / np.pi, "arcsec")


@dataclass(frozen=True)
class Number:
    """One result: measured value, expanded uncertainty (k = 2), truth; the last two None for an error itself."""

    name: str
    measured: float
    expanded_uncertainty: float | None
    truth: float | None
    unit: str


def run(runs: Path, as_json: bool, campaign: Path = CAMPAIGN) -> None:
    """Run the campaign, and print its results, their true values, and the path of the report."""
    start = time.monotonic()
    plan = load_campaign(campaign)
    beams, drift, balls = folders = work(plan, runs=runs, quiet=as_json)
    numbers = compare(plan, beams, drift)
    agreement = agree(drift, balls)
    seconds = time.monotonic() - start
    if as_json:
        tests = [describe(folder) for folder in folders]
        plain = {"numbers": [number.__dict__ for number in numbers], "comparison": as_plain(agreement)}
        show_json({"ok": True, "seconds": seconds, "tests": tests, **plain})
        return
    settings = plan.tests[1].settings
    speed = settings.schedule[0].spindle_speed
    minutes = f"{settings.duration / 60:.0f} simulated minutes at {speed:.0f} /min"
    show(f"{plan.bench.machine}: {minutes}, measured over the network")
    show(f"through {len(plan.bench.instruments)} simulated instruments in {seconds:.0f} s.\n")
    rows = [
        [n.name, f"{n.measured:.2f}", f"{n.expanded_uncertainty:.2f}", f"{n.truth:.2f}", n.unit]
        for n in numbers
        if n.expanded_uncertainty is not None and n.truth is not None
    ]
    show(table(["", "measured", "U (k=2)", "truth", ""], rows) + "\n")
    for number in numbers:
        if number.truth is None:
            show(f"{number.name}: {number.measured:.1f} {number.unit}")
    show("\nDo the five sensors and the probing of four balls agree?")
    show(text(agreement))
    for folder in folders:
        show(f"\nreport on {folder.data['test']}: {describe(folder)['report']}")


def compare(plan: CampaignPlan, beams: RunFolder, drift: RunFolder) -> list[Number]:
    """Return the results with the true values of the virtual machine."""
    machine, clock = machine_of(drift), float(drift.data["clock"]["time"])
    with datasets.load(drift.errors or drift.path) as errors:
        settings = plan.tests[1].settings
        numbers = [*_drift_numbers(machine, errors, clock, settings), *_ranges(machine, errors, clock)]
    with datasets.load(beams.errors or beams.path) as found:
        numbers += _beam_numbers(machine, found)
    return numbers


def agree(drift: RunFolder, balls: RunFolder) -> xr.Dataset:
    """Return the comparison of two methods and the truth, by their common displacements."""
    with datasets.load(drift.errors or drift.path) as bar, datasets.load(balls.errors or balls.path) as probed:
        found = {str(drift.data["test"]): bar, str(balls.data["test"]): probed, "truth": truth_of(balls)}
        return compared(found, at=probed.attrs["functional_point"], freedoms=DOF[:3])


def _drift_numbers(machine: VirtualMachine, errors: xr.Dataset, clock: float, settings: Any) -> list[Number]:
    zero = float(errors.attrs["reference_time"])
    t = np.asarray(errors["time"].values)
    point = errors.attrs["functional_point"]
    off = [e for e in settings.schedule if e.compensation]
    half = settings.average / 2  # the time of a mean is its middle
    end = int(np.searchsorted(t, off[0].at - zero - half, side="right")) - 1
    [truth] = _truth(machine, errors, clock, t[[end]], point)
    numbers = []
    for k, (name, (factor, unit)) in enumerate([("EX", UM), ("EY", UM), ("EZ", UM), ("EA", ARCSEC), ("EB", ARCSEC)]):
        value = float(errors[name].values[end])
        expanded = 2.0 * float(np.sqrt(errors["covariance"].values[end, k, k]))
        what = f"{name} after {(t[end] + zero) / 60:.0f} min, compensation on"
        numbers.append(Number(what, value * factor, expanded * factor, float(truth[k]) * factor, unit))
    for event, axis, step in steps(errors, events(Source(errors, provenance=read(errors)))):
        if step is not None:
            what = f"E{axis} step, compensation of {axis} switched off"
            [corrected] = machine.state.correction_at([clock + zero + 60 * event.minute])
            true_step = float(corrected["XYZ".index(axis)])
            numbers.append(Number(what, 1e6 * step.step, 2e6 * step.u_step, 1e6 * true_step, "um"))
    return numbers


def _ranges(machine: VirtualMachine, errors: xr.Dataset, clock: float) -> list[Number]:
    """Return the ISO 230-3 ranges of the first hour: displacements at the two levels, Z and the tilts."""
    hour = np.arange(3601.0)
    numbers = []
    low, high = np.asarray(errors["level_height"].values, dtype=float)
    quantities = {
        "X1": (low, 0),
        "X2": (high, 0),
        "Y1": (low, 1),
        "Y2": (high, 1),
        "Z": (0.0, 2),
        "A": (0.0, 3),
        "B": (0.0, 4),
    }
    for name, (height, freedom) in quantities.items():
        truth = _truth(machine, errors, clock, hour, (0.0, 0.0, height))[:, freedom]
        factor, unit = ARCSEC if freedom > 2 else UM
        measured = errors["iso_value"].sel(quantity=name, measure="range_60min").item()
        u = errors["iso_uncertainty"].sel(quantity=name, measure="range_60min").item()
        what = f"d({name})60, range in the first 60 min"
        numbers.append(Number(what, measured * factor, 2.0 * u * factor, float(np.ptp(truth)) * factor, unit))
    return numbers


def _truth(machine: VirtualMachine, errors: xr.Dataset, clock: float, time: Array, point: Any) -> Array:
    """Return the true twists (time, 6) at times of a result, relative to its reference state."""
    reference = clock + float(errors.attrs["reference_time"])
    t = time + reference
    shift = np.asarray(point, dtype=float) - machine.spindle_functional_point
    twists = machine.spindle_twist(t) - machine.spindle_twist(np.array([reference]))
    return np.asarray(move(twists, shift))


def _beam_numbers(machine: VirtualMachine, found: xr.Dataset) -> list[Number]:
    """Return the deviations of the detected and of the nominal beams from the true ones, root mean squares."""
    frame = machine.frame
    numbers = []
    for what, origin, direction in (
        ("beam detection", found["beam_origin"].values, found["beam_direction"].values),
        ("nominal beams", frame.nominal_origin, frame.nominal_direction),
    ):
        across = np.cross(origin - frame.true_origin, frame.true_direction)
        numbers.append(Number(f"{what}: origins off by (across the beam, rms)", _rms(across) * 1e6, None, None, "um"))
        angle = np.cross(direction, frame.true_direction)
        numbers.append(Number(f"{what}: directions off by (rms)", _rms(angle) * ARCSEC[0], None, None, "arcsec"))
    return numbers


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))
