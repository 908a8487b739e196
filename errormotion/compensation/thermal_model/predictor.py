"""A thermal model evaluated reading by reading: the same prediction as of a whole record, in constant time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.compensation.online.prediction import Prediction
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import EXTRAPOLATION, ThermalModel
from errormotion.compensation.thermal_model.record import PARAMETERS
from errormotion.errors import CompensationError
from errormotion.kinematics import twists


class ThermalPredictor:
    """Predicts the errors of a machine from its latest readings.

    Parameters
    ----------
    model : Dataset
        A thermal model.
    functional_point : (3,), optional
        Point of the translations, m, in the frame of the model; default: the functional point of the model.

    Raises
    ------
    CompensationError
        The model does not predict one of the translations, or a rotation that the functional point requires.
    """

    def __init__(self, model: xr.Dataset, functional_point: Array | None = None) -> None:
        ds = model
        features = ThermalModel(model).features
        own = np.asarray(ds.attrs["functional_point"], dtype=float)
        lever = np.zeros(3) if functional_point is None else np.asarray(functional_point, dtype=float) - own
        self._to_point = twists.adjoint(shift=lever)
        coefficient = ds["coefficient"].values
        known = np.isfinite(coefficient).all(axis=1)
        needed = known if lever.any() else known[:3]
        if not needed.all():
            raise CompensationError(
                "The model predicts " + ", ".join(str(d) for d in ds["dof"].values[known]) + "; an offset "
                "requires EX, EY and EZ, and at another functional point than that of the model the three rotations.",
                code="model.freedoms.missing",
            )
        self._coefficient = np.where(known[:, None], coefficient, np.nan)
        self._covariance = ds["coefficient_covariance"].values
        self._misfit = ds["misfit"].values
        span = EXTRAPOLATION * (ds["feature_high"].values - ds["feature_low"].values)
        self._low, self._high = ds["feature_low"].values - span, ds["feature_high"].values + span
        self._columns = [_Column(feature) for feature in features]
        self._first: dict[str, float] = {}
        self._time = -math.inf

    @property
    def temperatures(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return self._sources(parameter=False)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the working parameters."""
        return self._sources(parameter=True)

    def _sources(self, *, parameter: bool) -> tuple[str, ...]:
        found = (column.feature for column in self._columns)
        return tuple(dict.fromkeys(each.source for each in found if each.parameter == parameter))

    def update(self, time: float, temperature: Mapping[str, float], parameter: Mapping[str, float]) -> Prediction:
        """Process the readings of one time, and return the prediction for it.

        Parameters
        ----------
        time : float
            s, later than before. The first readings are the reference state.
        temperature : mapping of str to float
            degC by sensor; NaN or absent: unknown.
        parameter : mapping of str to float
            ``spindle_speed`` in 1/min and ``feed`` in m/s; NaN or absent: unknown.
        """
        if not time > self._time:
            raise CompensationError(
                f"Expected a reading after {self._time:g} s; found {time:g} s.", code="model.reading.not_later"
            )
        self._time = time
        values = {name: self._changed(name, value) for name, value in temperature.items()}
        speeds = {name: parameter[name] * factor for name, factor in PARAMETERS.items() if name in parameter}
        row = np.array([self._input(column, values, speeds, time) for column in self._columns])
        unknown = ~np.isfinite(row)
        missing = tuple(
            dict.fromkeys(c.feature.source for c, absent in zip(self._columns, unknown, strict=True) if absent)
        )
        if missing:
            return Prediction(np.full(6, np.nan), np.full(6, np.nan), missing)
        errors = self._coefficient @ row
        variance = np.einsum("j,kji,i->k", row, self._covariance, row) + self._misfit**2  # freedoms are independent
        outside = (row < self._low) | (row > self._high)
        names = tuple(c.feature.name for c, out in zip(self._columns, outside, strict=True) if out)
        covariance = twists.transform_covariance(np.diag(variance), self._to_point)
        return Prediction(twists.known_product(self._to_point, errors), np.sqrt(np.diagonal(covariance)), outside=names)

    @staticmethod
    def _input(column: _Column, values: Mapping[str, float], speeds: Mapping[str, float], time: float) -> float:
        held = speeds if column.feature.parameter else values
        return column.update(time, held.get(column.feature.source, math.nan))

    def _changed(self, name: str, value: float) -> float:
        if not math.isfinite(value):
            return math.nan
        return value - self._first.setdefault(name, value)


class _Column:
    """State of one feature."""

    def __init__(self, feature: Feature) -> None:
        self.feature = feature
        self._last: tuple[float, float] | None = None  # time and input
        self._response = 0.0
        self._past: deque[tuple[float, float]] = deque()  # for a lag

    def update(self, time: float, value: float) -> float:
        """Process the input at a time, and return the feature; NaN if the input is unknown."""
        if not math.isfinite(value):
            return math.nan
        value = value**self.feature.power
        if self.feature.lag:
            return self._lagged(time, value)
        if self.feature.time_constant:
            return self._responded(time, value)
        return value

    def _lagged(self, time: float, value: float) -> float:
        self._past.append((time, value))
        wanted = time - self.feature.lag
        while len(self._past) > 1 and self._past[1][0] <= wanted:
            self._past.popleft()
        (before, low) = self._past[0]
        if wanted < before:
            return 0.0  # before the reference state
        if len(self._past) == 1:
            return low
        after, high = self._past[1]
        return low + (high - low) * (wanted - before) / (after - before)

    def _responded(self, time: float, value: float) -> float:
        if self._last is None:
            self._last = time, value
            return 0.0
        step = (time - self._last[0]) / self.feature.time_constant
        decay, before = math.exp(-step), self._last[1]
        if self.feature.parameter:  # the value applies since the previous time
            self._response = self._response * decay + value * -math.expm1(-step)
        else:  # exact response to a ramp
            ramp = (value - before) / step
            self._response = value - ramp + (self._response - before + ramp) * decay
        self._last = time, value
        return self._response
