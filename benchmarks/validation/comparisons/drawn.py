"""Error datasets that are drawn from their own covariance, over the true warm-up of a virtual machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.twin import Event, VirtualMachine

START = "2026-03-02T07:00:00+00:00"
SPEED = Event(60.0, 12000.0, None)
SENSORS = ("frame", "spindle_front", "ambient")
"""Recorded temperatures of a dataset."""
NOISE = np.array([1e-7] * 3 + [5e-7] * 3)
"""Standard deviation of the noise of each instant, m, rad."""


@lru_cache(maxsize=8)
def warm_up(seed: int, kind: str = "gantry") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (n,), true errors at the origin (n, 6) since time 0 and temperatures (n, 3), every 10 s."""
    machine = VirtualMachine(kind, seed=seed)
    machine.start([SPEED])
    t = np.arange(0.0, 7501.0, 10.0)
    E = np.asarray((machine.truth_probing if kind == "gantry" else machine.truth_spindle)(t, np.zeros(3)).em.twist())
    columns = [machine.temperature_sensors.index(name) for name in SENSORS]
    return t, E - E[0], machine.temperatures(t)[:, columns]


@dataclass
class Drawn:
    """Parameters of a dataset: values without error, noise and sources (one standard uncertainty each)."""

    name: str
    time: np.ndarray
    values: np.ndarray
    temperature: np.ndarray
    sources: dict[str, np.ndarray]
    ids: Mapping[str, str] = field(default_factory=dict)
    factor: float = 1.0
    start: str = START
    mapping: np.ndarray = field(default_factory=lambda: np.eye(6))  # from measured to stated values
    point: np.ndarray = field(default_factory=lambda: np.zeros(3))  # functional point of values and sources
    targets: np.ndarray | None = None  # (n, 3) instead of times
    component: str = "tool"

    def dataset(self, rng: np.random.Generator | None, shared: Mapping[str, float] | None = None) -> xr.Dataset:
        """Return the dataset, drawn with a generator or exact without one; ``shared`` sources are given."""
        F = self.factor * np.array(list(self.sources.values())).reshape(-1, *self.values.shape)
        noise, values = self.factor * NOISE, self.values.copy()
        if rng is not None:
            z = rng.normal(size=len(F))
            given = shared or {}
            z = [given.get(name, own) for name, own in zip(self.sources, z, strict=True)]
            values = values + np.tensordot(z, F, axes=1) + noise * rng.normal(size=values.shape)
        names, A = list(self.sources), self.mapping
        F = F @ A.T
        recorded = {
            "temperature": (("time", "sensor"), self.temperature, {"units": "degC"}),
            "sensor": list(SENSORS),
        }
        return datasets.build_errors(
            values @ A.T,
            A @ np.diag(noise**2) @ A.T + np.einsum("sti,stj->tij", F, F),
            dims=("time",) if self.targets is None else ("target",),
            coords={"time": self.time, **(recorded if self.temperature.size else {})}
            if self.targets is None
            else {name: ("target", self.targets[:, k]) for k, name in enumerate("xyz")},
            influence=F,
            sources=names,
            source_groups=names,
            source_ids=dict(self.ids),
            start=self.start,
            component=self.component,
            machine="virtual gantry",
            frame="machine",
            functional_point=self.point,
            reference="cold",
            method=self.name,
            method_version="1",
            provenance={},
        )


def at(seed: int, step: float, name: str, kind: str = "gantry") -> Drawn:
    """Return the warm-up of one machine at equal intervals over two hours, without sources."""
    t, E, T = warm_up(seed, kind)
    every = slice(0, int(7200 / 10) + 1, int(step / 10))
    return Drawn(name, t[every], E[every], T[every], {})
