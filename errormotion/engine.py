"""The engine ``errormotion`` of xarray, for ``xr.open_dataset(file, engine="errormotion")`` and ``xr.open_datatree``.

xarray imports the engines of all packages when it opens the first file. From then on, datasets have the accessor
``ds.em`` with any engine, without an import of this package.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr
from xarray.backends import BackendEntrypoint

from errormotion.datasets.results import accessor
from errormotion.datasets.storage.disk import load
from errormotion.errors import DatasetError

_ = accessor  # registers ds.em


class ErrormotionEngine(BackendEntrypoint):
    """Engine for error datasets, raw datasets and readings, see `errormotion.datasets.load`, and for runs as a tree."""

    description: ClassVar[str] = "Open error datasets, raw datasets and run folders of errormotion"
    supports_groups: ClassVar[bool] = True
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
        return _without(load(_path(filename_or_obj, unknown)), drop_variables)

    def open_datatree(
        self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None, **unknown: Any
    ) -> xr.DataTree:
        """Return the datasets of a run folder; see `errormotion.record.open_run`.

        Raises
        ------
        DatasetError
            Not a path, or as `errormotion.datasets.load`.
        RunError
            As `errormotion.record.open_run`.
        """
        from errormotion.record import open_run

        tree = open_run(_path(filename_or_obj, unknown))
        return tree.map_over_datasets(lambda ds: _without(ds, drop_variables))

    def open_groups_as_dict(
        self, filename_or_obj: Any, *, drop_variables: str | Iterable[str] | None = None, **unknown: Any
    ) -> dict[str, xr.Dataset]:
        """Return the datasets of a run folder by their paths in the tree; see `open_datatree`."""
        tree = self.open_datatree(filename_or_obj, drop_variables=drop_variables, **unknown)
        return {node.path: node.to_dataset() for node in tree.subtree}

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return False: this engine is only used if it is stated."""
        del filename_or_obj
        return False


def _path(given: Any, unknown: Mapping[str, Any]) -> Path:
    if unknown:
        raise DatasetError(
            f"The engine 'errormotion' has no options; found {', '.join(sorted(unknown))}",
            code="engine.options.unknown",
        )
    if not isinstance(given, (str, os.PathLike)):
        raise DatasetError(f"Expected the path of a dataset; found {type(given).__name__}", code="engine.path.form")
    return Path(given)


def _without(ds: xr.Dataset, variables: str | Iterable[str] | None) -> xr.Dataset:
    dropped = [variables] if isinstance(variables, str) else list(variables or ())
    return ds.drop_vars([name for name in dropped if name in ds.variables])
