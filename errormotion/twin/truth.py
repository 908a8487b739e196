"""True errors as error datasets with covariance 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.kinematics.description import MachineDescription
from errormotion.twin.schedule import Event


@dataclass(frozen=True)
class Origin:
    """The virtual machine of a truth, and its schedule; ``description`` if it is not one of the two kinds."""

    name: str
    kind: str
    seed: int
    events: tuple[Event, ...]
    description: MachineDescription | None = None


def dataset(
    twist: Array,
    dims: str | tuple[str, ...],
    coords: Mapping[str, Any],
    component: str,
    functional_point: Array,
    reference: str,
    origin: Origin,
    frame: str = "machine",
) -> xr.Dataset:
    """Return an error dataset of true twists (..., 6), m and rad, over these dimensions."""
    settings: dict[str, Any] = {"kind": origin.kind, "schedule": [asdict(event) for event in origin.events]}
    if origin.description is not None:
        settings["machine"] = asdict(origin.description)
    return build_errors(
        twist,
        np.zeros((*twist.shape, 6)),
        dims=(dims,) if isinstance(dims, str) else dims,
        coords=coords,
        component=component,
        machine=origin.name,
        frame=frame,
        functional_point=functional_point,
        reference=reference,
        method="twin",
        method_version="1",
        provenance=provenance.make(settings, None, None, seed=origin.seed),
    )
