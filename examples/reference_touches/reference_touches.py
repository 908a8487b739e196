"""Drift of the tool from repeated touches of a reference on the table, imported from a file."""

from __future__ import annotations

from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from pydantic import Field

from errormotion.datasets.schemas import NO_LIMIT, NOISE, POSITION, XYZ, RawSchema, Row
from errormotion.measurement import Block, Constant, Datum, ModelMethod, Noise, Observed, Places, Problem
from errormotion.plugins import FigureOfMerit, MethodInfo, MethodSubject, Needs, PluginSettings

SCHEMA = "errormotion.raw.reference_touches/1"
READINGS = ("time", "direction", "repeat")
T = TypeVar("T")


class Unknowns(NamedTuple, Generic[T]):
    """EX, EY and EZ of each time."""

    error: T


class Known(NamedTuple, Generic[T]):
    """What is known with an uncertainty."""

    expansion: T


class ReferenceTouchesSettings(PluginSettings):
    """The test to plan or to simulate; an identification needs only the functional point."""

    interval: float = Field(300.0, gt=0, description="time between two series of touches, s")
    duration: float = Field(7200.0, gt=0, description="length of the test, s")
    repeats: int = Field(3, ge=1, description="touches along each axis at each time")
    noise: float = Field(0.5e-6, gt=0, description="standard deviation of one touch, m")
    height: float = Field(0.2, ge=0, description="of the reference above the table, m")
    functional_point: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="of the errors, m")


class ReferenceTouches(ModelMethod):
    """Drift of the tool from repeated touches of a reference on the table."""

    info = MethodInfo(
        id="reference_touches",
        summary="Drift of the tool from repeated touches of a reference on the table",
        status="simulated_only",
        cannot_see=("rotations", "a displacement of the reference on the table: it counts as drift of the tool"),
    )
    needs = Needs(instruments=(), raw_schema=SCHEMA)
    Settings = ReferenceTouchesSettings
    raw_schemas = (
        RawSchema(
            SCHEMA,
            variant="",
            marker="touch",
            rows=(
                Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "increasing; the first time is the reference state"),
                Row(
                    "touch", READINGS, "m", *POSITION, "position of the machine at the touch; NaN = none", missing=True
                ),
                Row("temperature", ("time",), "degC", -40.0, 100.0, "of the stand of the reference"),
                Row("height", (), "m", 0.0, 5.0, "of the reference above the table, along Z"),
                Row("expansion", (), "1/K", 0.0, 1e-4, "expansion coefficient of the stand"),
                Row("expansion_uncertainty", (), "1/K", 0.0, 1e-4, "its standard uncertainty"),
                Row("touch_noise", (), "m", *NOISE, "standard deviation of one touch"),
            ),
            labels=XYZ,
        ),
    )

    def observe(self, raw: xr.Dataset, settings: ReferenceTouchesSettings) -> Observed:
        """Return the model: a machine that is too far by E shows E less where it touches the reference."""
        y = raw["touch"].transpose(*READINGS).sel(direction=["x", "y", "z"]).values
        time, axis, _ = (index.ravel() for index in np.indices(y.shape))
        known, warmer = np.isfinite(y).any(axis=2), raw["temperature"].values - raw["temperature"].values[0]
        growth = np.where(axis == 2, float(raw["height"]) * warmer[time], 0.0)  # of the stand, by 1/K of expansion
        expansion = Constant(
            value=np.full((1, 1), float(raw["expansion"])),
            factor=np.full((1, 1, 1), float(raw["expansion_uncertainty"])),
            index=np.zeros(y.size, dtype=int),
            scale=1.0,
            group="expansion of the stand",
        )
        return Observed(
            problem=Problem(
                equation=lambda y, x, c: y + x.error[np.arange(y.size), axis] - c.expansion[:, 0] * growth,
                readings=y.ravel(),
                unknowns=Unknowns(Block(start=np.zeros((len(y), 3)), index=time, scale=1.0, free=known)),
                constants=Known(expansion),
                noise=Noise(sd=np.full(y.size, float(raw["touch_noise"]))),
            ),
            places=Places(lambda x, _: np.where(known, x.error, np.nan), len(y)),
            datum=Datum(np.tile(np.eye(3), (len(y), 1, 1)), np.eye(1, len(y)).T * np.ones(3), "reference state"),
            recorded=("touch", READINGS),
            freedoms=("EX", "EY", "EZ"),
            dims=("time",),
            coords={"time": raw["time"].values - raw["time"].values[0]},
            component="tool",
            functional_point=settings.functional_point,
            reference="first time",
            what="the touches",
        )

    def expected(self, settings: ReferenceTouchesSettings) -> xr.Dataset:
        """Return the touches of a machine that drifts by 10 to 30 um while the stand warms up by 2 K."""
        time = np.arange(0.0, settings.duration + 1e-9, settings.interval)
        warm = 1 - np.exp(-time / 1800.0)
        touch = np.array([0.1, 0.2, 0.3]) - warm[:, None] * [10e-6, -20e-6, 30e-6]
        touch[:, 2] += 11.5e-6 * settings.height * 2 * warm
        variables = {
            "touch": (READINGS, np.repeat(touch[..., None], settings.repeats, axis=2), "m"),
            "temperature": (("time",), 20 + 2 * warm, "degC"),
            "height": ((), settings.height, "m"),
            "expansion": ((), 11.5e-6, "1/K"),
            "expansion_uncertainty": ((), 1e-6, "1/K"),
            "touch_noise": ((), settings.noise, "m"),
        }
        return xr.Dataset(
            {name: (dims, value, {"units": unit}) for name, (dims, value, unit) in variables.items()},
            {"time": ("time", time, {"units": "s"}), "direction": list("xyz")},
            {"schema": SCHEMA, "machine": "expected"},
        )

    @staticmethod
    def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
        """Return the drift at the last time."""
        u = np.sqrt(np.diagonal(errors["covariance"].values[-1]))
        return [
            FigureOfMerit(f"drift of {name[1]}", float(errors[name][-1]), 2 * float(u[k]), "m")
            for k, name in enumerate(("EX", "EY", "EZ"))
        ]

    @classmethod
    def conformance(cls) -> tuple[MethodSubject, ...]:
        """Return the subject of the kit, whose axes are those of the machine."""
        still = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        simulated = partial(cls().simulate, ReferenceTouchesSettings())
        return (MethodSubject(cls, simulated, raw_vectors={}, measured=("touch",), motion=still),)
