"""Subject of the conformance kit: one tracker at four stations one after the other, 48 targets, some beams broken."""

from __future__ import annotations

import numpy as np
import xarray as xr

from errormotion.methods.multilateration import simulation
from errormotion.methods.multilateration.method import Multilateration
from errormotion.methods.multilateration.settings import Layout
from errormotion.plugins import MethodSubject
from errormotion.twin import VirtualMachine

TRACKER_SCALE = 0.5e-6
"""Relative error of the tracker's lengths, one standard deviation."""
STILL_AIR = {"temperature_uncertainty": 0.0, "pressure_uncertainty": 0.0, "humidity_uncertainty": 0.0}
"""Of the virtual tracker, whose lengths are those in the air."""


def subjects() -> tuple[MethodSubject, ...]:
    """Return the subjects of the kit. Their plan moves one station along Z only: a short search."""
    first, *others = Layout().stations
    places = [(first, (*first[:2], first[2] + 0.2)), *zip(others, others, strict=True)]
    boxes = [{"low": low, "high": high} for low, high in places]
    subject = MethodSubject(
        Multilateration,
        tracker_readings,
        settings={
            "scale_uncertainty": TRACKER_SCALE,
            "air": STILL_AIR,
            "planning": {"minimise": "mean", "boxes": boxes},
        },
        raw_vectors={"target_nominal": "point", "station_nominal": "point", "reflector": "point"},
        optional=("station_nominal", "reflector", "reading_time"),
        measured=("displacement",),
        seeds=100,
    )
    return (subject,)


def tracker_readings(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return distances of a reflector from four stations, and the true errors minus the undetermined rigid motion.

    Only the first seed states the chain of the machine: the errors of the axes have no effect on those of the targets.
    """
    machine = VirtualMachine("cframe", seed=seed)
    position = simulation.target_grid(machine, (4, 4, 3))
    scale = TRACKER_SCALE * np.random.default_rng([seed, 3]).normal()
    raw = simulation.raw(machine, position, seed=seed, scale=scale, missing=0.02)
    if seed:
        del raw.attrs["chain"]
    return raw, simulation.true_errors(machine, position)
