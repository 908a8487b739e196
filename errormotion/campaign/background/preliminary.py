"""The errors of a run in progress, from the samples that are stored so far."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from errormotion import datasets
from errormotion.campaign.files import TestPlan
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.runner import stored_plan
from errormotion.campaign.storage.store import committed_length
from errormotion.datasets.clock import noted
from errormotion.datasets.files.folders import looking_beside
from errormotion.errors import DatasetError, RunError


def samples(folder: RunFolder) -> int:
    """Return the number of stored samples of a run that are visible to readers; 0 before the first."""
    if not folder.raw.exists():
        return 0
    test = _test(folder)
    return committed_length(folder.raw, test.method().append_dim(test.settings))


def preliminary(folder: RunFolder) -> xr.Dataset:
    """Return the errors that the stored samples determine, with the settings of the run.

    Raises
    ------
    RunError
        The run is not one of a campaign, or has no samples yet.
    MethodError
        The stored samples do not determine the errors.
    DatasetError
        The stored samples are not a complete record.
    """
    test = _test(folder)
    if not samples(folder):
        raise RunError(f"{folder.path.name}: the run has no samples yet", code="run.no_samples")
    with looking_beside(Path(str(folder.data["campaign"].get("folder", folder.path)))):
        try:
            with datasets.load(folder.raw) as raw:
                errors = noted(test.method().identify(raw, test.settings).load(), raw)
        except (ArithmeticError, LookupError, ValueError) as error:  # an incomplete record is no defect of the method
            raise DatasetError(
                f"the samples so far do not determine the errors ({error})", code="raw.preliminary.undetermined"
            ) from error
    datasets.validate(errors)
    return errors


def _test(folder: RunFolder) -> TestPlan:
    try:
        return next(test for test in stored_plan(folder).tests if test.name == folder.data["test"])
    except (StopIteration, KeyError, TypeError, AttributeError):
        raise RunError(
            f"{folder.path}: expected the run folder of a campaign; found another folder", code="run.folder.other"
        ) from None
