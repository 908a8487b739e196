"""The engine ``errormotion`` of xarray: ``xr.open_dataset(file, engine="errormotion")``.

xarray imports the engines of all packages when it opens the first file, so that datasets have the accessor ``ds.em``
from then on, whatever the engine, without an import of this package.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr
from xarray.backends import BackendEntrypoint

from errormotion.datasets.results import accessor
from errormotion.datasets.storage.disk import load
from errormotion.errors import DatasetError

_ = accessor  # registers ds.em


class ErrormotionEngine(BackendEntrypoint):
    """Error datasets, raw datasets and readings, as `errormotion.datasets.load` opens them."""

    description: ClassVar[str] = "Open error datasets and raw datasets of errormotion"
    open_dataset_parameters: ClassVar[tuple[str, ...] | None] = ("filename_or_obj", "drop_variables")

    def open_dataset(
        self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None, **unknown: Any
    ) -> xr.Dataset:
        """Return the dataset of a file or folder; see `errormotion.datasets.load`.

        Raises
        ------
        DatasetError
            Not a path, or as `errormotion.datasets.load`.
        """
        if unknown:
            raise DatasetError(f"The engine 'errormotion' has no options; found {', '.join(sorted(unknown))}")
        if not isinstance(filename_or_obj, (str, os.PathLike)):
            raise DatasetError(f"Expected the path of a dataset; found {type(filename_or_obj).__name__}")
        ds = load(Path(filename_or_obj))
        dropped = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return ds.drop_vars([name for name in dropped if name in ds.variables])

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return False: files are opened by this engine where it is named only."""
        del filename_or_obj
        return False
