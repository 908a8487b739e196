"""The raw dataset as arrays."""

from dataclasses import dataclass

import numpy as np

from ballbar_test.path import DIRECTIONS, SENSES, TAU
from errormotion.errors import MethodError

PLANES = ("XY", "YZ", "ZX")
REFERENCE_TEMPERATURE = 20.0  # degC


@dataclass(frozen=True)
class Circles:
    """Readings in the order of ``DIRECTIONS``, (2, run, sample), SI.

    ``length`` is NaN for a missing reading. ``time`` is relative to the calibration of the bar; None if it is not
    stated. ``expansion`` is the effect of the temperature of the bar on its length, (2, run), ``shared`` that of one
    standard uncertainty of each source common to all readings.
    """

    length: np.ndarray
    angle: np.ndarray
    time: np.ndarray | None
    expansion: np.ndarray
    shared: dict[str, np.ndarray]
    radius: float
    feed: float
    noise: float
    centre: np.ndarray
    plane: str
    axes: np.ndarray

    @property
    def sense(self):
        """+1 or -1 at each reading."""
        return np.broadcast_to(np.array(list(SENSES.values()))[:, None, None], self.length.shape)


def read(raw, notes):
    """Return the readings of a raw dataset that conforms to its schema.

    Raises
    ------
    MethodError
        Directions of travel, axes or constants are inconsistent.
    """
    dims = ("direction_of_travel", "run", "sample")
    labels = sorted(map(str, raw["direction_of_travel"].values)) if "direction_of_travel" in raw.coords else []
    if labels != sorted(DIRECTIONS):
        raise MethodError(f"direction_of_travel: expected the labels CCW and CW; found {', '.join(labels) or 'none'}")
    sorted_raw = raw.sel(direction_of_travel=list(DIRECTIONS))
    plane, axes = _plane(raw)

    def over_readings(name):
        return np.array(sorted_raw[name].transpose(*dims).values, float)

    radius, feed = _positive(raw, "nominal_radius"), _positive(raw, "feed")
    length, angle = over_readings("length"), over_readings("angle")
    length[~np.isfinite(angle)] = np.nan
    time = None
    if "reading_time" in raw:
        time = over_readings("reading_time")
        length[~np.isfinite(time)] = np.nan
    if not np.isfinite(length).any(axis=(1, 2)).all():
        raise MethodError("length: expected readings in both directions of travel; found none in one or both")
    expansion, shared = _temperature(sorted_raw, radius, length.shape[:2], notes)
    return Circles(
        length=length,
        angle=np.mod(angle, TAU),
        time=time,
        expansion=expansion,
        shared={"calibration of the bar": np.full(length.shape[:2], _scalar(raw, "length_uncertainty", 0.0)), **shared},
        radius=radius,
        feed=feed,
        noise=_scalar(raw, "length_noise", np.nan),
        centre=np.array(_xyz(raw["centre"]), float),
        plane=plane,
        axes=axes,
    )


def _plane(raw):
    axes = np.array(_xyz(raw["axis_direction"].transpose("axis", "direction")), float)
    labels = raw["axis"].values if "axis" in raw.coords else np.array(list("XYZ"))[np.abs(axes).argmax(axis=1)]
    names = [str(name) for name in labels]
    plane = "".join(names)
    if plane not in PLANES:
        raise MethodError(
            f"axis: expected the two axes of the circle in the order X Y, Y Z or Z X; found {' '.join(names)}"
        )
    if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-3):
        raise MethodError("axis_direction: expected two unit vectors at right angles to one another")
    return plane, axes


def _xyz(array):
    return (array.sel(direction=["x", "y", "z"]) if "direction" in array.coords else array).values


def _scalar(raw, name, default):
    return float(raw[name]) if name in raw else default


def _positive(raw, name):
    value = float(raw[name])
    if not value > 0:
        raise MethodError(f"{name}: expected a value above 0; found {value:g}")
    return value


def _temperature(raw, radius, shape, notes):
    """Return the expansion of the bar, (2, run), and its shared uncertainties."""
    if "temperature" not in raw:
        return np.zeros(shape), {}
    if "expansion" not in raw:
        notes.append("The temperature of the bar is not corrected: its expansion coefficient is not stated.")
        return np.zeros(shape), {}
    excess = raw["temperature"].transpose("direction_of_travel", "run").values - _scalar(
        raw, "calibration_temperature", REFERENCE_TEMPERATURE
    )
    if not np.isfinite(excess).all():
        raise MethodError("temperature: expected one of the bar for each circle; found NaN. Omit the variable")
    coefficient = float(raw["expansion"])
    return coefficient * radius * excess, {
        "expansion coefficient of the bar": radius * excess * _scalar(raw, "expansion_uncertainty", 0.0),
        "temperature of the bar": np.full(shape, coefficient * radius * _scalar(raw, "temperature_uncertainty", 0.0)),
    }
