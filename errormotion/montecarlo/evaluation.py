"""Monte Carlo evaluation of the result of a method: parallel trials, stored on disk and resumed after a stop."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import xarray as xr
from numpy.random import SeedSequence
from numpy.typing import NDArray

from errormotion import __version__, datasets, plugins
from errormotion.arrays import Array
from errormotion.datasets.storage.disk import reading
from errormotion.errors import MethodError, RunError
from errormotion.montecarlo.adaptive import block_size, propagate, summarise
from errormotion.montecarlo.intervals import min_samples
from errormotion.montecarlo.places import chosen_places
from errormotion.montecarlo.result import build
from errormotion.montecarlo.store import Store
from errormotion.montecarlo.trials import linear_uncertainty, sample, trial_model_of, values_of
from errormotion.montecarlo.validation import UNDECIDED, validate_linear
from errormotion.parallel import Workers, one_thread_at_a_time
from errormotion.plugins import TrialModel

PROBABILITY = 0.95
CHUNK = 20
"""Number of trials of one task; a killed process loses at most the trials of its task."""
MAX_TRIALS = 100_000
"""Number of trials after which the adaptive procedure stops."""
MIN_TRIALS = min_samples(PROBABILITY)
"""Smallest number of trials: samples are needed outside both ends of the interval."""
FLOOR = 1e-13
"""Largest difference that is regarded as a rounding error, m or rad."""

_identify_lock = threading.Lock()
_prepare_lock = threading.Lock()


class Progress(Protocol):
    """Receives the progress."""

    def stage(self, name: str, total: float | None = None) -> None:
        """Start a stage."""

    def advance(self, done: float) -> None:
        """Report the completed trials."""

    def note(self, text: str) -> None:
        """Report an intermediate result."""


class Task(NamedTuple):
    """Arguments of one task; valid on any machine that sees the same paths."""

    raw: str
    method_id: str
    method_version: str
    settings: str
    version: str
    seed: int
    block: int
    first: int
    stop: int
    rows: tuple[int, ...]


@dataclass
class _Run:
    """State of an evaluation in progress."""

    store: Store
    workers: Workers
    common: tuple[str, str, str, str, str]
    seed: int
    rows: tuple[int, ...]
    freedoms: int
    progress: Progress | None
    done: int = 0
    reasons: dict[str, int] = field(default_factory=dict)

    def block(self, sequence: SeedSequence, size: int) -> Array:
        """Return the trials (size, places times freedoms) of a block; trials on disk are not repeated."""
        number = int(sequence.spawn_key[-1])
        complete = self.store.block(number, size)
        if complete is None:
            ready = self.store.chunks(number, size)
            self._advance(sum(len(part) for part in ready))
            tasks = [
                Task(*self.common, self.seed, number, part.start, part.stop, self.rows)
                for part in _missing(ready, size)
            ]
            self.workers.run(compute, tasks, lambda k, answer: self._keep(tasks[k], *answer), self._lost)
            complete = self.store.join(number, size)
        else:
            self._advance(size)
        return complete

    def _keep(self, task: Task, values: Array, reasons: dict[str, int]) -> None:
        self.store.keep(task.block, range(task.first, task.stop), values)
        for reason, count in reasons.items():
            self.reasons[reason] = self.reasons.get(reason, 0) + count
        self._advance(len(values))

    def _lost(self, _number: int, reason: str) -> None:
        raise RunError(f"A task of the Monte Carlo evaluation was lost: {reason}", code="monte_carlo.task.lost")

    def _advance(self, trials: int) -> None:
        self.done += trials
        if self.progress is not None:
            self.progress.advance(self.done)


def evaluate(
    raw: str | Path,
    method_id: str,
    settings: Any,
    errors: xr.Dataset,
    folder: str | Path,
    *,
    trials: int | None = None,
    digits: int = 1,
    seed: int = 0,
    scheduler: str = "threads",
    workers: int | None = None,
    progress: Progress | None = None,
    most: int = MAX_TRIALS,
    keep: bool = False,
) -> xr.Dataset:
    """Evaluate a result by the Monte Carlo method (JCGM 101), and compare its linear intervals.

    Parameters
    ----------
    raw : path
        The raw dataset.
    method_id : str
        The method.
    settings : PluginSettings
        Settings of the identification.
    errors : Dataset
        Result of the method for the raw dataset with these settings.
    folder : path
        Folder for the trials during the evaluation; an interrupted evaluation is continued from it.
    trials : int, optional
        Number of trials; default: adaptive, 7.9.4, until all results are stable and every verdict is clear.
    digits : int
        Meaningful digits of the standard uncertainties, 1 or 2.
    seed : int
        Seed of the random numbers; the result does not depend on the scheduler and the number of workers.
    scheduler : str
        ``threads``, ``processes``, ``sync``, or the address of a Dask scheduler.
    workers : int, optional
        Number of threads or processes.
    progress : Progress, optional
        Receives the progress.
    most : int
        Largest number of trials of the adaptive procedure.
    keep : bool
        Whether the trials are kept at the end, for example until the result is saved; see `Store.remove`.

    Returns
    -------
    Dataset
        Schema ``errormotion.monte_carlo/1``.

    Raises
    ------
    MethodError
        The method has no trial model, the number of trials is too small, or no trial had a result.
    RunError
        The folder contains trials of another evaluation, or the scheduler does not work.
    """
    if trials is not None and trials < MIN_TRIALS:
        raise MethodError(
            f"--monte-carlo: expected 'auto' or at least {MIN_TRIALS} trials; found {trials}",
            code="monte_carlo.trials.count",
        )
    if digits not in (1, 2):
        raise MethodError(
            f"--digits: expected 1 or 2 meaningful digits of an uncertainty; found {digits}", code="monte_carlo.digits"
        )
    if seed < 0:
        raise MethodError(f"--seed: expected 0 or a positive number; found {seed}", code="monte_carlo.seed")
    method = plugins.get("methods", method_id)
    common = (str(Path(raw).resolve()), method_id, method.info.version, settings.model_dump_json(), __version__)
    with _quiet():
        trial_model = _prepared(*common[:4])[1]
    rows, where = chosen_places(errors)
    linear, u = values_of(errors)[rows], linear_uncertainty(errors)[rows]
    store = Store(folder, _key(errors, common, seed))
    if progress is not None:
        progress.stage("Monte Carlo trials", trials)
    with store, Workers(scheduler, workers, __version__) as pool, _quiet():
        run = _Run(store, pool, common, seed, tuple(map(int, rows)), linear.shape[1], progress)
        enough = _Enough(linear.ravel(), u.ravel(), digits, progress)
        summary = propagate(
            run.block,
            trials=trials,
            probability=PROBABILITY,
            digits=digits,
            seed=seed,
            size=block_size(PROBABILITY, cheap=False),
            most=most,
            floor=FLOOR,
            enough=enough,
        )
    if (summary.missing[np.isfinite(linear.ravel())] == summary.trials).any():
        reason = max(run.reasons, key=run.reasons.__getitem__, default="unknown")
        raise MethodError(
            f"None of {summary.trials} trials had a value at all positions of the result: {reason}",
            code="monte_carlo.no_values",
        )
    verdict = validate_linear(linear.ravel(), u.ravel(), summary, floor=FLOOR)
    result = build(errors, where, linear, u, summary, verdict, seed, list(trial_model.sources), run.reasons)
    if not keep:
        store.remove()
    return result


@dataclass
class _Enough:
    """Condition that every verdict is clear; tested at growing intervals, since it sorts all samples."""

    linear: Array
    u: Array
    digits: int
    progress: Progress | None
    tested: int = 0

    def __call__(self, blocks: list[Array]) -> bool:
        if len(blocks) < 1.25 * self.tested:
            return False
        self.tested = len(blocks)
        validation = validate_linear(self.linear, self.u, summarise(blocks, PROBABILITY, self.digits), floor=FLOOR)
        open_ = int((validation.verdict[np.isfinite(self.linear)] == UNDECIDED).sum())
        if self.progress is not None:
            self.progress.note(f"{open_} of {int(np.isfinite(self.linear).sum())} values undecided")
        return open_ == 0


def compute(*task: Any) -> tuple[Array, dict[str, int]]:
    """Execute one task: return values (trial, places times freedoms), and the number of failed trials by reason."""
    given = Task(*task)
    for what, wanted, given_value in (
        ("errormotion", given.version, __version__),
        (f"the method {given.method_id}", given.method_version, plugins.get("methods", given.method_id).info.version),
    ):
        if wanted != given_value:
            raise RunError(
                f"expected {what} in version {wanted}; found {given_value} on a worker. Install it there.",
                code="package.version.differs",
            )
    with _quiet():
        method, trial_model, shape = _prepared(given.raw, given.method_id, given.method_version, given.settings)
        sequence = SeedSequence(given.seed, spawn_key=(given.block,))
        with _identify_lock if one_thread_at_a_time() else nullcontext():
            values, reasons = sample(method, trial_model, sequence, range(given.first, given.stop), shape)
    return values[:, list(given.rows)].reshape(len(values), -1), reasons


def _prepared(raw: str, method_id: str, method_version: str, settings: str) -> tuple[Any, TrialModel, tuple[int, int]]:
    """Return method, trial model and (places, freedoms), computed once in each process."""
    with _prepare_lock:
        return _prepare(raw, method_id, method_version, settings)


@lru_cache(maxsize=1)
def _prepare(raw: str, method_id: str, _method_version: str, settings: str) -> tuple[Any, TrialModel, tuple[int, int]]:
    plugin = plugins.get("methods", method_id)
    method, chosen = plugin(), plugin.Settings.model_validate_json(settings)
    with reading(raw), datasets.load(raw) as dataset:
        errors = method.identify(dataset, chosen)
        trial_model = trial_model_of(method, dataset, chosen, errors)
    return method, trial_model, (values_of(errors).shape[0], values_of(errors).shape[1])


def _missing(ready: list[range], size: int) -> Iterator[range]:
    """Yield the missing trials, in chunks."""
    present: NDArray[np.bool_] = np.zeros(size, dtype=bool)
    for part in ready:
        present[part.start : part.stop] = True
    for first in range(0, size, CHUNK):
        stop = min(first + CHUNK, size)
        if not present[first:stop].all():
            yield range(first, stop)


def _key(errors: xr.Dataset, common: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return the data that identify an evaluation; evaluations with equal data have the same trials."""
    digest = sha256(values_of(errors).tobytes() + linear_uncertainty(errors).tobytes()).hexdigest()
    return {"result": digest, "method": common[1], "method_version": common[2], "settings": json.loads(common[3]),
            "errormotion": common[4], "seed": seed}  # fmt: skip


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings, which every trial would log again."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
