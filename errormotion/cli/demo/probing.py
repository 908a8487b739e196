"""``errormotion demo --controller linuxcnc``: the real LinuxCNC probes the balls of the virtual machine."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.campaign.files import load_campaign
from errormotion.cli.commands.campaigns.run import describe, work
from errormotion.cli.demo.spindle import ARCSEC, UM, Number
from errormotion.cli.output import show, show_json, table
from errormotion.datasets.schemas import DOF
from errormotion.instruments.simulators import world
from errormotion.instruments.transports import parse_address
from errormotion.twin import VirtualMachine

CAMPAIGN = Path(__file__).parent / "linuxcnc" / "campaign.toml"


def run(runs: Path, as_json: bool, campaign: Path = CAMPAIGN) -> None:
    """Run the campaign, and print the errors after the last cycle, their true values, and the path of the report.

    Raises
    ------
    BenchError
        LinuxCNC is not installed, or does not start.
    """
    start = time.monotonic()
    plan = load_campaign(campaign)
    address = parse_address(plan.bench.instruments[0].address)
    simulated = world(address.host, int(address.number("seed", 0)))  # that of the simulators
    (folder,) = work(plan, runs=runs, quiet=as_json)
    with datasets.load(folder.errors or folder.path) as errors, datasets.load(folder.raw) as raw:
        numbers = compare(simulated.machine, errors, float(raw.attrs["clock_origin"]))
        minutes = float(errors["time"][-1]) / 60
    seconds = time.monotonic() - start
    if as_json:
        test = describe(folder)
        show_json({"ok": True, "seconds": seconds, "tests": [test], "numbers": [n.__dict__ for n in numbers]})
        return
    control = folder.data["instruments"][0]["identity"]
    show(
        f"{control['manufacturer']} {control['model']} {control['firmware']} moved and probed; {minutes:.0f} minutes of"
    )
    show(f"warm-up in {seconds:.0f} s. Errors since the cold cycle:\n")
    rows = [[n.name, f"{n.measured:.2f}", f"{n.expanded_uncertainty:.2f}", f"{n.truth:.2f}", n.unit] for n in numbers]
    show(table(["", "measured", "U (k=2)", "truth", ""], rows))
    show("\nEC is not measured: X and Y move the table, and only Z moves the tool.")
    show(f"\nreport on {folder.data['test']}: {describe(folder)['report']}")


def compare(machine: VirtualMachine, errors: xr.Dataset, origin: float) -> list[Number]:
    """Return the measured errors at the last cycle, and the true errors of the virtual machine."""
    at = errors["time"].values + origin
    truth = machine.truth_probing(at, errors.attrs["functional_point"])
    numbers = []
    for k, name in enumerate(DOF):
        factor, unit = ARCSEC if k > 2 else UM
        measured = float(errors[name][-1])
        if np.isnan(measured):
            continue
        u = float(np.sqrt(errors["covariance"].values[-1, k, k]))
        true = float(truth[name][-1] - truth[name][0])
        numbers.append(Number(name, measured * factor, 2 * u * factor, true * factor, unit))
    return numbers
