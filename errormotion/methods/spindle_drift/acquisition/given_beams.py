"""Beams from earlier tests: of the whole frame, or single beams under the names of their channels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.schema import CHANNELS

if TYPE_CHECKING:
    from collections.abc import Mapping

ALL_BEAMS = "beams"
"""Name of an input that contains all beams."""
REQUIRED = ("beam_origin", "beam_direction", "beam_covariance")


def given_beams(inputs: Mapping[str, xr.Dataset]) -> xr.Dataset | None:
    """Return origin, direction and covariance of the beams over ``beam`` (X1 X2 Y1 Y2 Z); None without inputs.

    Parameters
    ----------
    inputs : mapping of str to Dataset
        Error datasets of component ``beam``: ``beams`` contains all five; X1, X2, Y1, Y2 and Z contain one each, under
        any name, and take precedence over ``beams``.

    Raises
    ------
    MethodError
        An input of another name, several beams where one is expected, a channel without a beam, or a beam without a
        known zero point.
    """
    unknown = sorted(set(inputs) - {ALL_BEAMS, *CHANNELS})
    if unknown:
        raise MethodError(
            f"inputs: expected '{ALL_BEAMS}' or the names of channels ({', '.join(CHANNELS)}); "
            f"found {', '.join(unknown)}",
            code="beams.input.names",
        )
    if not inputs:
        return None
    beams = [_beam(inputs, name) for name in CHANNELS]
    frames = {str(part.attrs.get("frame", "machine")) for part in inputs.values()}
    if len(frames) > 1:
        raise MethodError(
            f"The beams are stated in several frames ({', '.join(sorted(frames))}); expected one. Convert them to one "
            "frame with ds.em.in_frame.",
            code="beams.input.frames",
        )
    return xr.concat(beams, dim="beam", join="override", combine_attrs="override").assign_coords(beam=list(CHANNELS))


def _beam(inputs: Mapping[str, xr.Dataset], channel: str) -> xr.Dataset:
    key = channel if channel in inputs else ALL_BEAMS
    if key not in inputs:
        raise MethodError(
            f"inputs: no beam for {channel}; found {', '.join(inputs)}. Expected one for each of "
            f"{', '.join(CHANNELS)}, or all of them as '{ALL_BEAMS}'.",
            code="beams.input.missing",
        )
    ds = inputs[key]
    missing = [name for name in REQUIRED if name not in ds.variables]
    if missing:
        raise MethodError(
            f"inputs: '{key}' is not the result of a beam detection or beam direction; missing: {', '.join(missing)}",
            code="beams.input.other",
        )
    if key == ALL_BEAMS:
        if channel not in ds["beam"].values:
            names = ", ".join(str(name) for name in ds["beam"].values)
            raise MethodError(
                f"inputs: '{key}' contains the beams {names}; expected {channel} as well", code="beams.input.missing"
            )
        one = ds[list(REQUIRED)].sel(beam=[channel])
    else:
        if ds.sizes.get("beam") != 1:
            raise MethodError(
                f"inputs: expected one beam in '{key}'; found {ds.sizes.get('beam', 0)}", code="beams.input.several"
            )
        one = ds[list(REQUIRED)].assign_coords(beam=[channel])
    if not np.isfinite(one["beam_origin"].values).all():
        raise MethodError(
            f"inputs: the zero point of beam {channel} is unknown, because its planes had no known points. Measure it "
            "on three planes with known points (layout.pivot), or by a beam detection.",
            code="beams.input.no_zero",
        )
    return one.transpose("beam", ...).reset_coords(drop=True)
