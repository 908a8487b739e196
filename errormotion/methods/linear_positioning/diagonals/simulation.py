"""Simulated displacements along diagonals of the virtual machine, with the true errors along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_deviations, provenance
from errormotion.methods.linear_positioning.diagonals.identification import DIMS
from errormotion.methods.linear_positioning.diagonals.lines import Line, distances, lines, squareness_of
from errormotion.methods.linear_positioning.schema import APPROACHES, SCHEMA, STOPS
from errormotion.methods.linear_positioning.virtual import MACHINE, instruments_of
from errormotion.twin import VirtualMachine

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

_M = {"units": "m"}


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of a reading, and of offset and slope of a run; and the reversal error; m."""

    noise: float = 0.3e-6
    offset: float = 0.4e-6
    slope: float = 0.2e-6
    reversal: float = 1.5e-6


def simulate_diagonals(
    settings: Settings, seed: int, behaviour: Scatter | None = None
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return readings along the diagonals of the settings, and the true errors along them, squareness included.

    The true squareness is that of the least-squares lines through the true deviations.
    """
    machine = VirtualMachine(MACHINE, seed=seed)
    behaviour = behaviour or Scatter()
    generator = np.random.default_rng(seed)
    draw = generator.standard_normal
    diagonals, distance = lines(settings), distances(settings)
    scale = settings.uncertainty.length_or_assumed * draw()
    shape = (settings.runs, 2, distance.shape[1])
    sign = np.array([1.0, -1.0])[:, None]
    true, read = [], []
    points = np.array([[line.point(float(s)) for s in stops] for line, stops in zip(diagonals, distance, strict=True)])
    displaced = machine.geometry.twist(points)[..., :3]
    for line, stops, moved in zip(diagonals, distance, displaced, strict=True):
        displacement = stops - stops[0]
        deviation = (moved - moved[0]) @ line.unit - behaviour.reversal / 2.0
        angle = settings.uncertainty.alignment_or_assumed * draw(2)
        z = displacement / (displacement[-1] / 2.0) - 1.0
        drift = behaviour.offset * draw((shape[0], 1, 1)) + behaviour.slope * draw((shape[0], 1, 1)) * z
        errors = sign * behaviour.reversal / 2.0 + drift + behaviour.noise * draw(shape)
        true.append(deviation)
        read.append(deviation + errors + (scale - (angle @ angle) / 2.0) * displacement)
    variables: dict[str, Any] = {
        "diagonal_deviation": (STOPS, np.array(read), _M),
        "stop_point": (("diagonal", "stop", "direction"), points, _M),
        "functional_point": ("direction", np.zeros(3), _M),
        "length_uncertainty": ((), settings.uncertainty.length_or_assumed, {"units": "1"}),
        "alignment_uncertainty": ((), settings.uncertainty.alignment_or_assumed, {"units": "rad"}),
    }
    names = [line.name for line in diagonals]
    coords = {"diagonal": names, "approach": list(APPROACHES), "direction": list("xyz")}
    attrs = {"schema": SCHEMA, "machine": machine.name, "instruments": instruments_of(machine)}
    return xr.Dataset(variables, coords, attrs), _truth(machine, diagonals, distance, np.array(true))


def _truth(machine: VirtualMachine, diagonals: list[Line], distance: Array, true: Array) -> xr.Dataset:
    sensitivity = np.array([np.tile([*line.unit, 0.0, 0.0, 0.0], (distance.shape[1], 1)) for line in diagonals])
    square = {
        name: float((np.polyfit(distance[k], true[k], 1)[0] - np.polyfit(distance[j], true[j], 1)[0]) / coefficient)
        for name, k, j, coefficient in squareness_of([line.unit for line in diagonals])
    }
    return build_deviations(
        true,
        np.zeros_like(true),
        sensitivity,
        dims=DIMS,
        coords={
            "diagonal": ("diagonal", [line.name for line in diagonals], {"long_name": "diagonal of the volume"}),
            "squareness_of": list(square),
        },
        component="tool",
        machine=machine.name,
        frame="machine",
        functional_point=np.zeros(3),
        reference="zero of the instrument",
        method="twin",
        method_version="1",
        provenance=provenance.make({"kind": machine.kind}, None, None, seed=machine.seed),
        extras={"squareness": xr.DataArray(list(square.values()), dims="squareness_of", attrs={"units": "rad"})},
    )
