"""The evaluation of a result in a file beside that of its errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import xarray as xr

from errormotion import datasets
from errormotion.montecarlo.evaluation import Progress, evaluate
from errormotion.montecarlo.store import Store


def file_beside(errors: Path) -> Path:
    """Return the file of the evaluation of a file of errors."""
    return errors.with_suffix(".monte_carlo.nc")


def evaluate_beside(
    raw: Path,
    method_id: str,
    settings: Any,
    errors: xr.Dataset,
    file: Path,
    *,
    trials: int | None = None,
    digits: int = 1,
    seed: int = 0,
    scheduler: str = "threads",
    workers: int | None = None,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Evaluate a result by the Monte Carlo method, and store it beside its ``file``.

    The trials are in a folder beside it while the evaluation is in work; one that was interrupted is continued. The
    other arguments are those of `errormotion.montecarlo.evaluate`.

    Raises
    ------
    MethodError, RunError, DatasetError
        As `errormotion.montecarlo.evaluate`; the file of the evaluation exists.
    KeyboardInterrupt
        The operator stopped it; the message states where the trials are.
    """
    folder = file.with_suffix(".trials")
    try:
        found = evaluate(
            raw, method_id, settings, errors, folder, trials=trials, digits=digits, seed=seed, scheduler=scheduler,
            workers=workers, progress=progress, keep=True,
        )  # fmt: skip
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(f"The trials are kept in {folder}; repeat the command to continue.") from error
    datasets.save(found, file_beside(file))
    Store(folder, {}).remove()
    return found
