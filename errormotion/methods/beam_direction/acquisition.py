"""Acquisition: a point sensor on a stage measures the faces of a sine gauge one after the other.

The stage searches each face along the beam, from far to near, moves to mid-range, and then along X, Y and Z (or along a
given path). It stops at each position, and several readings are averaged.
"""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import clock
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.errors import MethodError
from errormotion.methods.beam_direction.motions import search_start, stage_path
from errormotion.methods.beam_direction.planning import design
from errormotion.methods.beam_direction.schema import SCHEMA
from errormotion.plugins.virtual import is_virtual

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from errormotion.methods.beam_direction.settings import BeamDirectionSettings
    from errormotion.plugins import Bench


NO_VALUE = "no value"
_CENTRING_MOVES = 5
_CENTRED, _SIGN_MOVE, _SEARCH_STEP = 0.05, 0.1, 0.5
"""Largest distance from mid-range, move that determines the sign, and step of the search, as shares of the range."""


def measure_planes(
    bench: Bench,
    settings: BeamDirectionSettings,
    inputs: Mapping[str, xr.Dataset],  # noqa: ARG001 - the same for every method
    done: xr.Dataset | None,
) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each face of the gauge, to be joined along ``plane``.

    Parameters
    ----------
    bench : Bench
        With a ``point_lds`` and a ``controller`` that moves the stage (``move_to``, ``state``). The operator is
        requested to set the gauge; a virtual machine sets it.
    settings : BeamDirectionSettings
    inputs : mapping
        Not used.
    done : Dataset, optional
        Data of an interrupted run, whose faces are not measured again. A virtual machine that was restarted repeats
        them and discards the data, so that the other faces are those of a run without interruption.

    Raises
    ------
    MethodError
        No control on the bench moves the stage, or a face is outside the search.
    DatasetError
        The calibration of the settings is not found; raised before the measurement starts.
    """
    if settings.compensation is not None:
        InclinationCalibration.find(settings.compensation)
    setup = Setup(bench, settings)
    longest = max(len(positions) for positions in setup.paths)
    finished = 0 if done is None else int(done.sizes["plane"])
    repeats = done is not None and setup.origin is not None and clock.restarted(done, setup.origin)
    for number in range(0 if repeats else finished, len(settings.planes)):
        setup.set_face(number)
        middle = setup.approach(number)
        raw = setup.measure(number, middle, longest)
        if number >= finished:
            yield raw


class Setup:
    """Sensor, stage and gauge of a bench.

    Attributes
    ----------
    normals : ndarray (k, 3)
        Of the faces, as commanded.
    paths : list of ndarray (n, 3)
        Stage positions on each face about its middle, m.
    origin : float or None
        Time of a virtual machine at the start, s; None for a real one.
    """

    def __init__(self, bench: Bench, settings: BeamDirectionSettings) -> None:
        self.bench, self.settings, self.layout = bench, settings, settings.layout
        self.sensor = bench.of_kind("point_lds")
        self.control: Any = control_of(bench)
        virtual = is_virtual(self.control)
        self.origin: float | None = float(self.control.state()["time"]) if virtual else None
        self.low, self.high = (float(x) for x in self.sensor.measuring_range)
        self.middle = float(self.sensor.mid_range)
        u = np.array(self.layout.nominal_direction, np.float64)
        self.beam = u / np.linalg.norm(u)
        self.sign = 1.0 if settings.moves == "sensor" else -1.0
        self.normals = design.plane_normals(np.array([(face.inclination, face.rotation) for face in settings.planes]))
        self.paths = [stage_path(settings, normal, self.range) for normal in self.normals]
        self.invalid: Counter[str] = Counter()

    @property
    def range(self) -> float:
        """Length of the sensor's range, m."""
        return self.high - self.low

    def set_face(self, number: int) -> None:
        """Move the sensor away, and set the gauge to a face."""
        face = self.settings.planes[number]
        self.move(self.start() - self.sign * self.layout.search * self.beam)
        self.bench.ask(
            f"Face {number + 1} of {len(self.settings.planes)}: set the sine gauge to an inclination of "
            f"{np.degrees(face.inclination):.6g} deg and its turntable to {np.degrees(face.rotation):.6g} deg.",
            "set_target",
            kind="plane",
            inclination=face.inclination,
            rotation=face.rotation,
        )

    def start(self) -> Array:
        """Return the start position of the search for a face, m.

        Raises
        ------
        MethodError
            The settings state none.
        """
        return search_start(self.settings, self.middle)

    def move(self, position: Array) -> Array:
        """Move the stage and return the position reported by the control, m."""
        self.control.move_to([float(x) for x in position])
        return np.array(self.control.state()["position"], np.float64)

    def read(self) -> float:
        """Return the mean of several readings, m; NaN if fewer than half of them have a value. Counts those without."""
        values = np.empty(self.layout.average)
        reasons: Counter[str] = Counter()
        for i in range(values.size):
            values[i] = self.sensor.read()
            if np.isnan(values[i]):
                reasons[getattr(self.sensor, "no_value", "") or NO_VALUE] += 1
        self.invalid.update(reasons)
        valid = values[np.isfinite(values)]
        return float(valid.mean()) if 2 * valid.size >= values.size else float("nan")

    def approach(self, number: int) -> Array:
        """Search a face along the beam, from far to near, and return the stage position at mid-range, m.

        Raises
        ------
        MethodError
            No reading, or readings that do not decrease towards the face.
        """
        forward = self.sign * self.beam
        steps = np.arange(-self.layout.search, self.layout.search + 1e-12, _SEARCH_STEP * self.range)
        name = f"Face {number + 1}"
        for step in steps:
            position = self.move(self.start() + step * forward)
            reading = self.read()
            if np.isfinite(reading):
                break
        else:
            raise MethodError(
                f"{name}: no reading from {-self.layout.search * 1e3:g} to {self.layout.search * 1e3:g} mm along the "
                f"beam about the stage position {_mm(self.start())} mm. Check layout.start or layout.pivot, the "
                "nominal direction, and the setting of the gauge; or increase layout.search.",
                code="beam.face.no_reading",
            )
        advance = _SIGN_MOVE * self.range if reading > self.middle else -_SIGN_MOVE * self.range
        position = self.move(position + advance * forward)
        change = (self.read() - reading) / advance
        if not abs(change + 1) < 0.5:
            raise MethodError(
                f"{name}: while the sensor moves by {advance * 1e3:g} mm towards the face the reading changes by "
                f"{change * advance * 1e3:.3g} mm; expected {-advance * 1e3:g} mm. Check the sign of the readings, the "
                "nominal direction, and whether the stage carries the sensor or the target (setting moves).",
                code="beam.sensor.gain",
            )
        for _ in range(_CENTRING_MOVES):
            off = self.read() - self.middle
            if abs(off) < _CENTRED * self.range:
                break
            position = self.move(position + off * forward)
        self.invalid.clear()  # readings that are missing during the search are not counted
        return position

    def measure(self, number: int, middle: Array, longest: int) -> xr.Dataset:
        """Return the raw dataset of one face, padded to ``longest`` readings."""
        distance, stage = np.full(longest, np.nan), np.full((longest, 3), np.nan)
        for i, offset in enumerate(self.paths[number]):
            stage[i] = self.move(middle + offset)
            distance[i] = self.read()
        return self._dataset(number, distance, stage)

    def noise(self) -> float:
        """Return the standard deviation of an average, m."""
        stated = getattr(self.sensor.settings, "noise", None)
        return float((stated or self.layout.noise) / np.sqrt(self.layout.average))

    def _dataset(self, number: int, distance: Array, stage: Array) -> xr.Dataset:
        m, one = {"units": "m"}, {"units": "1"}
        p = self.layout
        variables: dict[str, Any] = {
            "distance": (("plane", "reading"), distance[None], m),
            "stage": (("plane", "reading", "direction"), stage[None], m),
            "nominal_normal": (("plane", "direction"), self.normals[number : number + 1], one),
            "nominal_direction": ("direction", self.beam, one),
            "distance_noise": ((), self.noise(), m),
            "mid_range": ((), self.middle, m),
            "reading_range": ("limit", np.array([self.low, self.high]), m),
        }
        if p.speckle > 0:
            variables |= {"speckle": ((), p.speckle, m), "speckle_length": ((), p.speckle_length, m)}
        if p.nominal_origin is not None:
            variables["nominal_origin"] = ("direction", np.array(p.nominal_origin), m)
        if p.triangulation_normal is not None:
            t = np.array(p.triangulation_normal)
            variables["triangulation_normal"] = ("direction", t / np.linalg.norm(t), one)
        if p.pivot is not None:
            variables["plane_point"] = (("plane", "direction"), np.array([p.pivot]), m)
            variables["plane_point_uncertainty"] = ((), p.pivot_uncertainty, m)
        invalid, self.invalid = dict(self.invalid), Counter()
        return xr.Dataset(
            variables,
            coords={"direction": list("xyz")},
            attrs={
                "schema": SCHEMA,
                "machine": self.bench.machine,
                "frame": "machine",
                "moves": self.settings.moves,
                **({} if self.settings.receiver is None else {"receiver": self.settings.receiver}),
                "sensor": type(self.sensor).info.id,
                "average": p.average,
                "start": datetime.now(UTC).isoformat(timespec="seconds"),
                "dropped": 0,
                "invalid": invalid,
                **({} if self.origin is None else {clock.ORIGIN: self.origin}),
            },
        )


def _mm(position: Array) -> str:
    return "({:.3f}, {:.3f}, {:.3f})".format(*(position * 1e3))


def control_of(bench: Bench) -> Any:
    """Return the control that moves the sensor.

    Raises
    ------
    MethodError
        The bench has none.
    """
    control = bench.of_kind("controller") if bench.has_kind("controller") else None
    if control is None or not hasattr(control, "move_to"):
        raise MethodError(
            "Expected an instrument of kind 'controller' that can move the sensor to a position (move_to) over the "
            "faces of the gauge; the bench has none. Measure manually, write the readings to a table, and use "
            "'errormotion identify READINGS.csv'.",
            code="bench.controller.no_moves",
        )
    return control
