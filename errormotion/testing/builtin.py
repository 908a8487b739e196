"""What the kit needs to know of the built-in plugins beyond what they say themselves."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion.plugins import Group, InstrumentSubject, MethodSubject
from errormotion.twin import Event, VirtualMachine


def builtin_subjects(
    group: Group, plugin_id: str, cls: Any
) -> tuple[MethodSubject, ...] | tuple[InstrumentSubject, ...]:
    """Return the subjects of a built-in plugin; none where the kit needs no help, or knows none."""
    if (group, plugin_id) == ("methods", "normal_vector"):
        return (normal_vector(cls),)
    if (group, plugin_id) == ("instruments", "profile_files"):
        return (InstrumentSubject(cls, str(scan_file())),)
    if (group, plugin_id) == ("instruments", "mtconnect"):
        return (mtconnect(cls),)
    if (group, plugin_id) in (("instruments", "controller_probe"), ("instruments", "virtual_controller")):
        return (on_virtual_machine(cls),)
    if (group, plugin_id) == ("instruments", "dprnt"):
        return (InstrumentSubject(cls, "sim://cframe/printer", faults=()),)  # they show in lines, and nobody prints
    if (group, plugin_id) == ("instruments", "tracker_table"):
        return (InstrumentSubject(cls, str(length_table())),)
    return ()


def on_virtual_machine(cls: Any) -> InstrumentSubject:
    """Return what moves the virtual machine; what is wrong with it shows when it moves, not when it is read."""
    machine = ("alarm", "estop", "no_trip", "tripped")
    return InstrumentSubject(cls, "sim://cframe/controller", harmless=("split", *machine))


def mtconnect(cls: Any) -> InstrumentSubject:
    """Return ``mtconnect``: what harms its observations does not harm its state, where an alarm is a word."""
    return InstrumentSubject(cls, "sim://cframe/mtconnect", harmless=("split", "overrun", "jump", "restart", "alarm"))


def own_folder() -> Path:
    """Return a new folder that lasts as long as this process."""
    folder = Path(tempfile.mkdtemp(prefix="errormotion-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def length_table() -> Path:
    """Return a table of lengths from three stations to five targets; one beam was broken."""
    lines = [f"S{k},{i},{1500 + 100 * k + 7 * i:.4f},20.{i},1013.2,45" for k in range(3) for i in range(5)]
    lines[7] = "S1,2,,20.2,1013.2,45"
    path = own_folder() / "lengths.csv"
    path.write_text(
        "\n".join(["station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]", *lines]) + "\n",
        encoding="utf-8",
    )
    return path


@cache
def scan_file() -> Path:
    """Return a scan of 350 profiles as a file that lasts as long as this process; three heights are unknown."""
    folder = own_folder()
    x, y = 12.5e-6 * np.arange(60), 25e-6 * np.arange(350)
    heights = 1e-3 * np.sin(np.add.outer(700.0 * y, 5000.0 * x))
    heights[10:13, 7] = np.nan
    scan = xr.Dataset(
        {"height": (("profile", "point"), heights, {"units": "m"})},
        {"x": ("point", x, {"units": "m"}), "y": ("profile", y, {"units": "m"})},
    )
    scan.to_netcdf(folder / "scan.nc", engine="h5netcdf")
    return folder / "scan.nc"




def normal_vector(cls: Any) -> MethodSubject:
    """Return ``normal_vector`` on a machine whose table moves in X and Y, so that the frame is turned about Z alone.

    A gantry shows all six freedoms, but single precision at 4 m is as coarse as its touches.
    """
    balls = tuple({"centre": place} for place in ((-0.24, -0.2, 0.06), (0.24, -0.19, 0.23), (0.23, 0.2, 0.09)))
    return MethodSubject(
        cls,
        touched_balls,
        settings={"tool_axes": "Z", "functional_point": PROBED, "balls": balls},
        setting_vectors={"functional_point": "point"},
        raw_vectors={"touch": "point", "approach": "direction", "ball_nominal": "point"},
        optional=(
            *("touch_time", "touch_flag", "approach", "ball_radius", "ball_nominal", "touch_noise"),
            *("temperature", "spindle_speed", "feed"),
        ),
        measured=("touch",),
        motion=((0.0, 0.0, 0.5), (0.1, -0.2, 0.05)),
        seeds=120,
    )


#: Where the error of the probing machine is stated, m.
PROBED = (0.0, 0.0, 0.15)


def touched_balls(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the touches of four balls, cold and six times while the spindle warms up, and the true error.

    A cycle takes two minutes; its mean state is that of its middle.
    """
    virtual = VirtualMachine("cframe", seed=seed)
    virtual.start((Event(120.0, 12000.0, None),))
    raw = virtual.raw_normal_vector(600.0 * np.arange(7), seed=seed, cycle=120.0)
    truth = virtual.truth_probing(60.0 + 20.0 * np.arange(190), PROBED)
    for name in truth.data_vars:
        if truth[name].dims == ("time",):
            truth[name] = (truth[name] - truth[name][0]).assign_attrs(truth[name].attrs)
    return raw, truth
