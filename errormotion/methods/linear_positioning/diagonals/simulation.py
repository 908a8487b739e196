"""Displacements that a test along diagonals is expected to give, on the virtual machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.methods.linear_positioning.diagonals.lines import distances, lines
from errormotion.methods.linear_positioning.schema import APPROACHES, SCHEMA, STOPS

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings
    from errormotion.twin import VirtualMachine


def expected_diagonals(
    settings: LinearPositioningSettings, machine: VirtualMachine, reversal: float, scatter: float, drift: float
) -> xr.Dataset:
    """Return readings along the diagonals of the settings without noise, which states ``scatter`` and ``drift``, m."""
    diagonals, distance = lines(settings), distances(settings)
    points = np.array([[line.point(float(s)) for s in stops] for line, stops in zip(diagonals, distance, strict=True)])
    moved = machine.geometry.twist(points)[..., :3]
    along = np.einsum("dsi,di->ds", moved - moved[:, :1], np.array([line.unit for line in diagonals]))
    read = np.stack([along, along - reversal], axis=1)  # set to zero at the first stop, approached forward
    metre, count = {"units": "m"}, len(diagonals)
    variables: dict[str, Any] = {
        "diagonal_deviation": (STOPS, np.repeat(read[:, None], settings.runs, axis=1), metre),
        "stop_point": (("diagonal", "stop", "direction"), points, metre),
        "functional_point": ("direction", np.zeros(3), metre),
        "length_uncertainty": ((), settings.uncertainty.length_or_assumed, {"units": "1"}),
        "alignment_uncertainty": ((), settings.uncertainty.alignment_or_assumed, {"units": "rad"}),
        "reading_scatter": ("diagonal", np.full(count, scatter), metre),
        "run_drift": ("diagonal", np.full(count, drift), metre),
    }
    coords = {"diagonal": [line.name for line in diagonals], "approach": list(APPROACHES), "direction": list("xyz")}
    return xr.Dataset(variables, coords, {"schema": SCHEMA})
