"""Monte Carlo evaluation of a result in a file beside its errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import xarray as xr

from errormotion import datasets
from errormotion.montecarlo.evaluation import Progress, evaluate
from errormotion.montecarlo.store import Store


def evaluation_file(errors: Path) -> Path:
    """Return the file of the evaluation for a file of errors."""
    return errors.with_suffix(".monte_carlo.nc")


def evaluate_and_save(
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
    """Evaluate a result by the Monte Carlo method, and save the evaluation beside its ``file``.

    During the evaluation the trials are in a folder beside the file, from which an interrupted evaluation is continued.
    The other arguments are those of `errormotion.montecarlo.evaluate`.

    Raises
    ------
    MethodError, RunError, DatasetError
        As for `errormotion.montecarlo.evaluate`; or the file of the evaluation already exists.
    KeyboardInterrupt
        The operator stopped the evaluation; the message states the folder of the trials.
    """
    folder = file.with_suffix(".trials")
    try:
        result = evaluate(
            raw, method_id, settings, errors, folder, trials=trials, digits=digits, seed=seed, scheduler=scheduler,
            workers=workers, progress=progress, keep=True,
        )  # fmt: skip
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(f"The trials are kept in {folder}; repeat the command to continue.") from error
    datasets.save(result, evaluation_file(file))
    Store(folder, {}).remove()
    return result
