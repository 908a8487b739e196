"""The expected uncertainty of the tests of a campaign."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from errormotion.campaign.files import CampaignPlan, TestPlan
from errormotion.datasets.files.folders import looking_beside
from errormotion.tolerances.conformity import FIELD_UNITS


def planned(plan: CampaignPlan, test: TestPlan) -> xr.Dataset:
    """Return the planned error dataset of a test, whose covariance is the expected one."""
    method, settings = test.method(), test.settings
    with looking_beside(plan.folder):
        settings = method.planning_settings(settings, plan.bench.chosen(test.instruments).settings_by_kind)
        result: xr.Dataset = method.plan(settings)
    return result


def expected(errors: xr.Dataset) -> list[dict[str, Any]]:
    """Return the largest expanded uncertainty (k = 2) of every freedom in a planned error dataset."""
    variances = np.diagonal(errors.em.covariance().values, axis1=-2, axis2=-1)
    parts = []
    for k, name in enumerate(errors.em.names):
        seen = variances[..., k][np.isfinite(variances[..., k])]
        if seen.size:
            factor, unit = FIELD_UNITS[errors[name].attrs["units"]]
            largest = 2.0 * float(np.sqrt(seen.max())) * factor
            parts.append({"name": name, "expanded_uncertainty": largest, "unit": unit})
    return parts
