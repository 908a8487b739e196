"""Comparison of a model with a campaign that was not used for its fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.compensation.thermal_model.model import ThermalModel
from errormotion.datasets.schemas import DOF
from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Check:
    """Comparison of a model with one campaign; NaN for errors that are unknown.

    Attributes
    ----------
    rms : (6,)
        Of the measured errors, m and rad.
    remaining : (6,)
        RMS of measured minus predicted.
    removed : (6,)
        1 - remaining / rms.
    held : (6,)
        Fraction of the times at which the 95 % interval of measured minus predicted contains 0.
    outside : float
        Fraction of the times outside the training range.
    predicted : Dataset
    """

    rms: Array
    remaining: Array
    removed: Array
    held: Array
    outside: float
    predicted: xr.Dataset


def check(model: ThermalModel, campaign: xr.Dataset) -> Check:
    """Compare predicted and measured errors of a campaign.

    Raises
    ------
    DatasetError
        The campaign has another component or functional point, or lacks an input of the model.
    """
    for name in ("component", "frame"):
        if campaign.attrs.get(name) != model.dataset.attrs[name]:
            raise DatasetError(
                f"Expected errors of {name} '{model.dataset.attrs[name]}'; found '{campaign.attrs.get(name)}'",
                code="model.attribute.differs",
            )
    there, here = (np.asarray(each.attrs["functional_point"], dtype=float) for each in (model.dataset, campaign))
    if not np.allclose(here, there, atol=1e-6):
        raise DatasetError(
            f"Expected errors at {there.tolist()} m; found {here.tolist()} m. Move the errors with ds.em.at(point).",
            code="model.point.differs",
        )
    predicted = model.predict(campaign)
    measured = np.column_stack([campaign[name].values for name in DOF])
    difference = measured - np.column_stack([predicted[name].values for name in DOF])
    variance = sum(
        np.diagonal(each["covariance"].transpose("time", "dof", "dof_").values, axis1=1, axis2=2)
        for each in (campaign, predicted)
    )
    known = np.isfinite(difference)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = _root_mean_square(np.where(known, measured, np.nan))
        remaining = _root_mean_square(difference)
        inside = np.abs(difference) <= 1.96 * np.sqrt(variance)
        held = np.where(known.any(axis=0), inside.sum(axis=0, where=known) / np.maximum(known.sum(axis=0), 1), np.nan)
        removed = 1 - remaining / rms
    return Check(rms, remaining, removed, held, float(predicted["outside"].mean()), predicted)


def _root_mean_square(values: Array) -> Array:
    count = np.isfinite(values).sum(axis=0)
    return np.where(count > 0, np.sqrt(np.nansum(values**2, axis=0) / np.maximum(count, 1)), np.nan)
