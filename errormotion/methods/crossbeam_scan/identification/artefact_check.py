"""Check of the artefacts for motion, by repeated cold scans and by comparison with their neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.identification.carriage import Carriage
from errormotion.methods.crossbeam_scan.identification.consistency import Consistency, cold_repeats, moved_artefacts
from errormotion.methods.crossbeam_scan.identification.registrations import Registrations

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import Settings


MOVED = "the artefact had moved"
"""Reason stated for errors that are excluded because their artefact moved."""


@dataclass(frozen=True)
class ArtefactCheck:
    """Errors that are caused by the motion of an artefact.

    Attributes
    ----------
    wrong : ndarray of bool, (cycle, artefact)
        Scans of artefacts after they had moved.
    since : ndarray, (artefact,)
        Time of the first scan after an artefact moved, s; NaN where it did not.
    notes : list of str
        Messages for the user.
    """

    wrong: NDArray[np.bool_]
    since: Array
    notes: list[str]

    def extras(self) -> dict[str, Any]:
        """Return the extra variables of the error dataset."""
        return {"moved": ("position", np.isfinite(self.since)), "moved_since": ("position", self.since, {"units": "s"})}


def check_artefacts(
    axis: Carriage,
    found: Registrations,
    settings: Settings,
    positions: Array,
    time: Array,
    cold: list[int],
    warm: list[int],
) -> ArtefactCheck:
    """Return which artefacts moved, from the repeated cold scans and from a comparison with their neighbours.

    Parameters
    ----------
    axis : Carriage
    found : Registrations
    settings : Settings
    positions : (artefact,)
        m.
    time : (warm cycle,)
        s, increasing.
    cold, warm : list of int
        Cycles; those of ``cold`` after the first are repeats of it.
    """
    repeatability = (settings.repeatability_shift, settings.repeatability_turn)
    wrong, since = np.zeros(found.reason.shape, dtype=bool), np.full(positions.size, np.nan)
    notes = _cold_notes(axis, positions, cold[1:], repeatability)
    consistency = moved_artefacts(
        time,
        positions,
        axis.profiler[warm],
        axis.profiler_covariance[warm],
        repeatability=repeatability,
        cold_share=found.cold_share[warm],
    )
    if not consistency.tested:
        notes.append("Too few artefacts to detect one that moved: at least four are needed.")
    for one in consistency.moved:
        wrong[warm[one.since :], one.artefact] = True
        since[one.artefact] = time[one.since]
    notes += _moved_notes(consistency, positions, time, settings.moved == "exclude")
    return ArtefactCheck(wrong, since, notes)


def _cold_notes(axis: Carriage, positions: Array, repeats: list[int], repeatability: tuple[float, float]) -> list[str]:
    if not repeats:
        return []
    found = cold_repeats(axis.profiler[repeats], axis.profiler_covariance[repeats], repeatability=repeatability)
    notes = []
    for repeat, k in np.argwhere(found.suspicious):
        shift, turn = _size(axis.profiler[repeats[repeat], k])
        notes.append(
            f"The artefact at {positions[k]:g} m has moved between the cold scan and its repetition "
            f"({shift:.1f} um, {turn:.1f} urad). Check its clamping and the thermal equilibrium of the machine."
        )
    return notes


def _moved_notes(found: Consistency, positions: Array, time: Array, excluded: bool) -> list[str]:
    notes = []
    for one in found.moved:
        shift, turn = _size(one.step)
        notes.append(
            f"The artefact at {positions[one.artefact]:g} m moved before the scan at {time[one.since] / 60:.1f} min, "
            f"by {shift:.1f} um and {turn:.1f} urad relative to the others; its later errors are "
            + ("excluded." if excluded else "kept, but not reliable.")
        )
    return notes


def _size(twist: Array) -> tuple[float, float]:
    """Return the lengths of displacement and rotation, um and urad."""
    shift, turn = np.linalg.norm(np.nan_to_num(twist).reshape(2, 3), axis=1) * 1e6
    return float(shift), float(turn)
