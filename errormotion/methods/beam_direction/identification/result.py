"""Error dataset of a beam, with a check bar if one was measured."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import provenance
from errormotion.measurement.identification import dataset, solve
from errormotion.methods.beam_direction.identification.beam import observe
from errormotion.methods.beam_direction.identification.check_bar.result import bar_extras, identify_bar
from errormotion.methods.beam_direction.identification.sensor import Sensor

if TYPE_CHECKING:
    from errormotion.measurement.method import ModelMethod
    from errormotion.measurement.observed import Observed
    from errormotion.methods.beam_direction.settings import BeamDirectionSettings


def identify(method: ModelMethod, raw: xr.Dataset, settings: BeamDirectionSettings) -> xr.Dataset:
    """Return an error dataset of component ``beam``: the beam minus the nominal beam.

    Raises
    ------
    MethodError
        Data that do not determine the beam; the message names the plane.
    """
    sensor = Sensor.of(raw, settings)
    if "distance" not in raw:
        return identify_bar(raw, sensor, settings, method.info.id, method.info.version)
    solved = solve(observe(raw, settings, sensor))
    steps = ["gradients by generalised least squares", "maximum likelihood of the beam"]
    steps += ["inclination compensation"] if sensor is not None else []
    origin = provenance.make(settings, raw, None, steps=steps)
    if sensor is not None:
        origin |= {"calibration": sensor.calibration.reference()}
    if "bar_distance" in raw:
        solved = replace(solved, observed=_with_bar(solved.observed, raw, sensor, settings))
    return dataset(method, solved, raw, method.info, origin)


def _with_bar(observed: Observed, raw: xr.Dataset, sensor: Sensor | None, settings: BeamDirectionSettings) -> Observed:
    """Return what was observed with the check bar, measured with the beam."""
    notes, extras = list(observed.notes), dict(observed.extras)
    p, u = (extras[name].values[0] for name in ("beam_origin", "beam_direction"))
    if not np.isfinite(p).all():
        notes.append("Check bar: the centre is relative to the nominal zero point, because the actual one is unknown.")
        p = np.nan_to_num(extras["nominal_origin"].values[0])
    covariance = np.nan_to_num(extras["beam_covariance"].values[0])
    calibration = sensor.calibration if sensor is not None else None
    moves = raw.attrs.get("moves", settings.moves)
    extras |= bar_extras(raw, p, u, covariance, calibration, moves, settings, notes)
    return replace(observed, notes=notes, extras=extras)
