"""Limits of online compensation."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from errormotion.datasets.units import Length, Time, Velocity


class Limits(BaseModel):
    """Limits of the offset, and the time for which it is held without a valid prediction.

    Attributes
    ----------
    limit : float
        Largest offset of each axis, m.
    slew : float
        Maximum rate of change of each axis, m/s.
    period : float
        Interval between two offsets, s.
    oldest : float
        Maximum age of a reading that a prediction uses, s.
    uncertainty : float
        Largest expanded uncertainty (k = 2) of a predicted offset, m.
    hold : float
        Time for which an offset is held without a valid prediction, s; then it ramps to zero.
    settle : float
        Time for which predictions must be valid to end a ramp to zero, s.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    limit: Length = Field(default=50e-6, gt=0, le=1e-3, description="largest offset of each axis")
    slew: Velocity = Field(default=1e-6, gt=0, le=20e-6, description="maximum rate of change of each axis")
    period: Time = Field(default=1.0, ge=0.05, le=10.0, description="interval between two offsets")
    oldest: Time = Field(default=10.0, gt=0, le=600.0, description="maximum age of a reading")
    uncertainty: Length = Field(default=20e-6, gt=0, description="largest expanded uncertainty of an offset, k = 2")
    hold: Time = Field(default=60.0, ge=0, le=3600.0, description="time of a constant offset without a prediction")
    settle: Time = Field(default=10.0, ge=0, le=3600.0, description="time of valid predictions to end a ramp to zero")
