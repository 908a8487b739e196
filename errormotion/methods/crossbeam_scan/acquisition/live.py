"""Progress of a campaign: the current pass and artefact, and the last registration."""

from __future__ import annotations

import logging
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy.spatial.transform import RigidTransform

from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification.chain import Rig, carriage_errors
from errormotion.methods.crossbeam_scan.identification.cutting import Scan, Scans
from errormotion.methods.crossbeam_scan.identification.registration import BlockMap, prepare, register

if TYPE_CHECKING:
    from errormotion.arrays import Array
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

log = logging.getLogger(__name__)

QUEUE_LENGTH = 2
"""Number of queued scans at which a further warm scan is skipped."""
_ARCSEC = np.degrees(1.0) * 3600.0


class LiveScans:
    """Register the scans of a campaign for display during acquisition.

    The registration is rigid, without drift along the scan and without checks of the artefacts; the result is
    identified from the complete record afterwards. The cold scan of every artefact is kept, reduced to blocks. Complete
    scans are registered in a thread that ends when the queue is empty. A warm scan is skipped when the queue is full,
    so that the measurement is never delayed.
    """

    def __init__(self, settings: CrossbeamScanSettings) -> None:
        self._settings = settings
        self._cold: dict[int, BlockMap] = {}
        self._parts: list[xr.Dataset] = []
        self._at = (-1, -1)
        self._waiting: deque[_Job] = deque()
        self._queued: set[int] = set()  # artefacts whose cold scan is known or queued
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._last_result = ""

    def update(self, chunk: xr.Dataset) -> str:
        """Process a chunk of the raw dataset; return the progress as a line of text."""
        if "record" not in chunk:
            return f"pocket, scan at a lift of {float(chunk['stage'].values[-1, 0, 2]) * 1e3:g} mm"
        position = chunk["position"].values
        axis = float(chunk["encoder_zero"]) + float(chunk["encoder_pitch"]) * chunk["encoder"].values
        cycle = chunk["cycle_of_line"].values
        known = np.flatnonzero(np.isfinite(axis))
        if not known.size:
            return self.text(chunk.sizes["cycle"], position.size)
        artefact = np.abs(axis[known, None] - position).argmin(axis=1)
        keys = np.stack([cycle[known], artefact], axis=1)
        starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=-1), axis=1))
        for low, high in zip(starts, [*starts[1:], known.size], strict=True):
            self._take(chunk.isel(line=known[low:high]), (int(keys[low, 0]), int(keys[low, 1])))
        self._complete(axis[known])
        return self.text(chunk.sizes["cycle"], position.size)

    def _take(self, part: xr.Dataset, at: tuple[int, int]) -> None:
        if at != self._at:
            self._submit()
            self._at = at
        self._parts.append(part)

    def _complete(self, axis: Array) -> None:
        """Submit the scan when the axis is past it."""
        if self._at[1] < 0 or not axis.size:
            return
        if axis[-1] > self._settings.positions[self._at[1]] + self._settings.scan_length / 2:
            self._submit()

    def _submit(self) -> None:
        """Queue the collected scan; skip a warm one when the queue is full."""
        parts, self._parts = self._parts, []
        if not parts:
            return
        job = _Job(parts, *self._at)
        with self._lock:
            if job.artefact in self._queued and len(self._waiting) >= QUEUE_LENGTH:
                return
            self._queued.add(job.artefact)
            self._waiting.append(job)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="live-scans", daemon=True)
                self._thread.start()

    def _work(self) -> None:
        """Register queued scans until the queue is empty."""
        while True:
            with self._lock:
                if not self._waiting:
                    self._thread = None
                    return
                job = self._waiting.popleft()
            self._register(job)

    def _register(self, job: _Job) -> None:
        where = f"pass {job.cycle + 1}, artefact {job.artefact + 1}: "
        try:
            height, x, y, _ = job.scan()
            warm = prepare(height, x, y)
            cold = self._cold.setdefault(job.artefact, warm)
            if cold is not warm:
                self._last_result = where + _text(cold, warm, job.parts[0])
        except MethodError as error:
            self._last_result = f"{where}{error}"
        except Exception:  # any error: the measurement continues without this display
            log.exception("%sregistration for the display failed", where)

    def text(self, cycles: int, artefacts: int) -> str:
        """Return the current pass and artefact, and the result of the last registration."""
        cycle, artefact = self._at
        text = f"pass {cycle + 1} of {cycles}, artefact {artefact + 1} of {artefacts}" if artefact >= 0 else ""
        return f"{text}; {self._last_result}" if self._last_result else text

    def wait(self) -> None:
        """Wait until every queued scan is registered."""
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()


@dataclass(frozen=True)
class _Job:
    """The lines of one scan."""

    parts: list[xr.Dataset]
    cycle: int
    artefact: int

    def scan(self) -> Scan:
        raw = xr.concat(
            self.parts, dim="line", data_vars="minimal", coords="minimal", compat="override", join="override",
            combine_attrs="drop",
        )  # fmt: skip
        return Scans(raw).scan(self.cycle, self.artefact)


def _text(cold: BlockMap, warm: BlockMap, raw: xr.Dataset) -> str:
    """Return the errors of the carriage with the standard uncertainty of the registration, in um and arcsec."""
    registration = register(cold, warm, point=np.zeros(3))
    pose = RigidTransform.from_matrix(np.asarray(raw["profiler_pose"].values, dtype=float))
    errors, covariance = carriage_errors(registration.twist, registration.covariance, Rig(pose, raw["lever"].values))
    size = np.sqrt(np.diag(covariance))
    shown = [f"E{k} {v * 1e6:+.1f} ({u * 1e6:.2f})" for k, v, u in zip("XYZ", errors, size, strict=False)]
    rotations = [
        f"E{k} {v * _ARCSEC:+.2f} ({u * _ARCSEC:.2f})" for k, v, u in zip("ABC", errors[3:], size[3:], strict=True)
    ]
    return f"{' '.join(shown)} um, {' '.join(rotations)} arcsec"
