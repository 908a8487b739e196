"""The true errors during a run on a virtual machine, as an error dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion import datasets, plugins
from errormotion.campaign.files import parse_bench
from errormotion.campaign.folder import RunFolder
from errormotion.datasets.timing import between, later
from errormotion.errors import BenchError, DatasetError, RunError
from errormotion.instruments.simulators.virtual_world.described import NAME
from errormotion.instruments.transports.address import parse_address

if TYPE_CHECKING:
    from errormotion.twin import VirtualMachine

EXACTNESS = 1e-10
"""Standard uncertainty of true errors, m and rad: readings of the virtual machine agree with them within 0.1 nm."""


def truth_of(folder: RunFolder) -> xr.Dataset:
    """Return the true errors at the places of the result of a run, with standard uncertainties of 0.1 nm and 0.1 nrad.

    The campaign of the run must have a timeline, which states the clock of the machine.

    Raises
    ------
    RunError
        The run has no timeline, no or several virtual machines, no errors, or its method does not state the truth.
    """
    machine, clock = machine_of(folder), folder.data["clock"]
    if folder.errors is None:
        raise RunError(
            f"{folder.path}: the run has no error dataset yet; identify its raw data first", code="run.no_errors"
        )
    method = plugins.get("methods", str(folder.data["method"]["id"]))
    with datasets.load(folder.errors) as errors:
        start = str(errors.attrs.get("start") or later(clock["start"], clock["time"]))
        stated = errors.attrs["component"] != "beam" and plugins.states(method, "truth")
        truth: xr.Dataset | None = method().truth(machine, errors, between(clock["start"], start)) if stated else None
        if truth is None:
            raise RunError(
                f"{folder.path}: the method does not state the true errors of {errors.attrs['component']}",
                code="truth.not_stated",
            )
        truth = truth.assign_attrs(
            {key: errors.attrs[key] for key in ("machine", "frame", "lever_axes") if key in errors.attrs}, start=start
        )
        truth["covariance"] = truth["covariance"] + EXACTNESS**2 * np.eye(6)
    try:
        datasets.validate(truth)
    except DatasetError as error:
        raise RunError(
            f"{folder.path}: the true errors are not a valid error dataset: {error}", code="schema.violated"
        ) from error
    return truth


def machine_of(folder: RunFolder) -> VirtualMachine:
    """Return the virtual machine of a run, with the schedule of its timeline; its clock is in ``folder.data``.

    Raises
    ------
    RunError
        The run has no timeline, or no or several virtual machines.
    """
    from errormotion.twin import Event, VirtualMachine

    clock, bench = folder.data.get("clock"), folder.data["bench"]
    if not isinstance(clock, dict):
        raise RunError(
            f"{folder.path}: expected a run of a campaign on a virtual machine with a table [timeline]; found none",
            code="truth.no_timeline",
        )
    plan = parse_bench(bench["text"], folder.path / f"run.json ({bench['file']})")
    addresses = [parse_address(each.address) for each in plan.instruments if each.address]
    machines = {(each.host, int(each.number("seed", 0))) for each in addresses if each.scheme == "sim"}
    if len(machines) != 1:
        names = ", ".join(f"sim://{host} with seed {seed}" for host, seed in sorted(machines)) or "none"
        raise RunError(
            f"{folder.path}: expected one virtual machine on the bench; found {names}", code="truth.machine.ambiguous"
        )
    ((name, seed),) = machines
    machine = VirtualMachine(plan.description if name == NAME and plan.description else name, seed=seed)
    try:
        machine.start([Event(**event) for event in clock["schedule"]])
    except BenchError as error:
        raise RunError(f"{folder.path / 'run.json'}: clock.schedule: {error}", code="truth.schedule.form") from error
    return machine
