"""Plugins of a laboratory in a separate distribution: a counter, and a method that records its counts.

Sample i is i micrometres, so every sample that is lost, doubled or out of place shows.
"""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.datasets import provenance
from errormotion.datasets.units import Frequency, Length
from errormotion.errors import InstrumentError, MethodError
from errormotion.plugins import (
    Identity,
    InstrumentInfo,
    Method,
    MethodInfo,
    Needs,
    PluginSettings,
    RandomSource,
    Samples,
    TrialModel,
)

STEP = 1e-6


class CounterSettings(PluginSettings):
    rate: Frequency = 1000.0
    block: int = 100
    real_time: Path | None = None
    """While this file exists, samples come as fast as the rate says; otherwise all at once."""
    simulated: bool = True
    refuses: bool = False
    breaks: Path | None = None
    """While this file exists, the instrument breaks down after 1000 samples."""


class Counter:
    info = InstrumentInfo("counter", "counter", "Counts micrometres", "simulated_only")
    Settings = CounterSettings
    opened: ClassVar[list[str]] = []

    def __init__(self, address: str, settings: CounterSettings | None = None) -> None:
        self.address, self.settings = address, settings or CounterSettings()

    def open(self) -> None:
        if self.settings.refuses:
            raise InstrumentError(f"{self.address}: nobody listens there")
        self.opened.append(self.address)

    def close(self) -> None:
        if self.address in self.opened:
            self.opened.remove(self.address)

    def identify(self) -> Identity:
        return Identity("Lab", "Counter", "17", simulated=self.settings.simulated)

    def read(self) -> float:
        return 0.0

    def stream(self, first: int) -> Iterator[Samples]:
        broken = self.settings.breaks is not None and self.settings.breaks.exists()
        start = time.monotonic()
        for block in range(10**6):
            at = first + block * self.settings.block
            if broken and at >= 1000:
                raise InstrumentError("the counter fell off the table")
            if self.settings.real_time is not None and self.settings.real_time.exists():
                time.sleep(max(0.0, start + (block + 1) * self.settings.block / self.settings.rate - time.monotonic()))
            values = np.arange(at, at + self.settings.block)[None] * STEP
            yield Samples(values, at, self.settings.rate, time.monotonic(), dropped=1, invalid={"dark": 2})


class RampSettings(PluginSettings):
    count: int = 1000
    level: Length = 0.01
    asks: str = ""
    needs_file: Path | None = None
    """Identification fails while this file does not exist."""


class Ramp(Method):
    info = MethodInfo("ramp", "Records a ramp", "simulated_only")
    needs = Needs(("counter",), "errormotion.raw.ramp/1")
    Settings = RampSettings

    def append_dim(self, settings: RampSettings) -> str:
        return "time"

    def progress(self, settings: RampSettings) -> float:
        return settings.count / 1000  # seconds at 1 kHz

    def acquire(
        self, bench: Any, settings: RampSettings, *, inputs: Mapping[str, xr.Dataset], done: xr.Dataset | None = None
    ) -> Iterator[xr.Dataset]:
        if settings.asks:
            bench.ask(settings.asks)
        first = done.sizes["time"] if done is not None else 0
        offset = float(inputs["zero"]["EX"][0]) if "zero" in inputs else 0.0
        for samples in bench.of_kind("counter").stream(first):
            left = settings.count - samples.first
            if left <= 0:
                return
            raw = xr.Dataset(
                {"distance": (("channel", "time"), samples.values[:, :left], {"units": "m"}), "level": settings.level},
                coords={"channel": ["A"]},
                attrs={
                    "schema": self.needs.raw_schema,
                    "sample_rate": samples.rate,
                    "time_start": samples.first / samples.rate,
                    "dropped": samples.dropped,
                    "invalid": '{"dark": 2}',
                    "offset": offset,
                },
            )
            raw["distance"].encoding = {
                "dtype": "uint32",
                "scale_factor": STEP,
                "add_offset": 0.0,
                "_FillValue": 2**32 - 1,
            }
            yield raw

    def identify(self, raw: xr.Dataset, settings: RampSettings) -> xr.Dataset:
        if settings.needs_file is not None and not settings.needs_file.exists():
            raise MethodError(f"the file {settings.needs_file} is missing")
        values = np.full((2, 6), np.nan)
        values[:, 0] = raw["distance"].values[0, [0, -1]]
        covariance = np.full((2, 6, 6), np.nan)
        covariance[:, 0, 0] = 1e-14
        return datasets.build_errors(
            values,
            covariance,
            dims=("time",),
            coords={"time": ("time", np.array([0.0, 60.0]), {"units": "s"})},
            component="spindle",
            machine="lab",
            frame="machine",
            functional_point=np.zeros(3),
            reference="cold",
            method="ramp",
            method_version="1",
            provenance=provenance.make(settings, raw, None),
        )

    def trial_model(self, raw: xr.Dataset, settings: RampSettings, errors: xr.Dataset) -> TrialModel:
        def draw(raw: xr.Dataset, settings: Any, generator: np.random.Generator) -> tuple[xr.Dataset, Any]:
            noise = 1e-7 * generator.normal(size=raw["distance"].shape)
            return raw.assign(distance=raw["distance"].copy(data=raw["distance"].values + noise)), settings

        return TrialModel(raw.load(), settings, {"noise": RandomSource(draw, own=True)})

    def plan(self, settings: RampSettings) -> xr.Dataset:
        raise MethodError("a ramp has no plan")
