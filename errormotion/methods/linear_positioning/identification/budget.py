"""Sources of uncertainty of the mean bidirectional deviations, after ISO/TR 230-9.

Independent from target to target: the scatter of the readings in the mean, and the errors of the instrument at each
target. Shared by all targets: drift from run to run, the scale of the instrument's lengths, its gain, the alignment of
the measured line, and expansion.

Alignment: along a line at the angle g to the axis, the length l is measured as ``l cos g``, too short by ``l g^2 / 2``.
With independent components of standard uncertainty u, g^2 / 2 has an exponential distribution of mean u^2 and standard
deviation u^2. The readings are not corrected, as the standard defines its figures: the source is the root mean square
of this one-sided error, sqrt(2) u^2. Where the alignment is stated, further figures are corrected for the mean; their
source is the standard deviation.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning.identification.expansion import Shared
from errormotion.methods.linear_positioning.identification.reading import Readings, length_uncertainty, per_freedom
from errormotion.methods.linear_positioning.identification.scatter import DRIFTS, Scatter
from errormotion.methods.linear_positioning.settings import ASSUMED_ALIGNMENT, ASSUMED_LENGTH, Settings

DRIFT, ALIGNMENT, LENGTH, GAIN, END = (
    *("drift from run to run", "alignment", "scale of the lengths"),
    *("gain of the instrument", "ends of the reference line"),
)
"""Groups of sources."""


def cosine_error(raw: xr.Dataset, readings: Readings, settings: Settings) -> Array | None:
    """Return the mean by which readings along the axis are too small by a stated alignment, (target,), m; else None."""
    stated = stated_alignment(raw, settings)
    return None if not stated else np.asarray(readings.lever * stated**2)


def stated_alignment(raw: xr.Dataset, settings: Settings) -> float | None:
    """Return the standard uncertainty of the alignment that the data or the settings state, rad; None if none does."""
    return float(raw["alignment_uncertainty"]) if "alignment_uncertainty" in raw else settings.uncertainty.alignment


def _alignment(raw: xr.Dataset, settings: Settings) -> float:
    stated = stated_alignment(raw, settings)
    return settings.uncertainty.alignment_or_assumed if stated is None else stated


def assumptions(raw: xr.Dataset, settings: Settings) -> list[str]:
    """Return a note on each standard uncertainty that is assumed, because neither data nor settings state it."""
    notes = [assumed_length(raw, settings)]
    if stated_alignment(raw, settings) is None:
        notes.append(
            f"Assumed, because it is not stated: an alignment of {1e3 * ASSUMED_ALIGNMENT:g} mrad "
            "(uncertainty.alignment). It contributes to the uncertainties only."
        )
    return [note for note in notes if note]


def assumed_length(raw: xr.Dataset, settings: Settings) -> str:
    """Return a note if the uncertainty of lengths is assumed; else an empty text."""
    if "length_uncertainty" in raw or settings.uncertainty.length is not None:
        return ""
    return (
        "Assumed, because it is not stated: an uncertainty of the instrument's lengths of "
        f"{1e6 * ASSUMED_LENGTH:g} um/m (uncertainty.length). It contributes to the uncertainties only."
    )


def instrument_sources(raw: xr.Dataset, readings: Readings, settings: Settings, mean: Array) -> list[Shared]:
    """Return the sources of instrument and alignment; ``mean`` (freedom, target) are the mean deviations."""
    count, m = mean.shape
    sources = []
    if readings.along in readings.freedoms:
        k = readings.freedoms.index(readings.along)
        for name, group, size in (
            (LENGTH, LENGTH, length_uncertainty(raw, settings)),
            ("angle of the measured line to the axis", ALIGNMENT, np.sqrt(2.0) * _alignment(raw, settings) ** 2),
        ):
            effect = np.zeros((count, m))
            effect[k] = size * readings.lever
            sources.append(Shared(name, group, effect))
    names = iso_names(readings.axis)
    for k, gain in enumerate(per_freedom(raw, "gain_uncertainty", count)):
        effect = np.zeros((count, m))
        effect[k] = gain * np.nan_to_num(mean[k])
        sources.append(Shared(f"gain of {names[readings.freedoms[k]]}", GAIN, effect))
    return [source for source in sources if np.abs(source.effect).max() > 0]


def drift_sources(readings: Readings, spreads: list[Scatter]) -> list[Shared]:
    """Return the effects of offset and slope of the runs on the means; one source each if no reading is missing."""
    sources = []
    names = iso_names(readings.axis)
    for k, spread in enumerate(spreads):
        known = np.isfinite(readings.x[k])
        with np.errstate(invalid="ignore", divide="ignore"):
            weight = np.nan_to_num(known / known.sum(axis=1, keepdims=True))  # (approach, run, target)
        share = 1.0 / max(int(known.any(axis=(1, 2)).sum()), 1)
        shared = {"": share * weight.sum(axis=0), " by approach": share * (weight[0] - weight[1])}
        for (kind, of_run), variance in zip(shared.items(), (spread.common_mean, spread.opposite_mean), strict=True):
            for drift, size, shape in zip(DRIFTS, np.sqrt(variance), (np.ones_like(spread.z), spread.z), strict=True):
                for i, row in enumerate(_rows(size * of_run * shape)):
                    effect = np.zeros((len(spreads), spread.z.size))
                    effect[k] = row
                    number = f" {i + 1}" if i else ""
                    name = f"{drift} of the runs{kind}, {names[readings.freedoms[k]]}{number}"
                    sources.append(Shared(name, DRIFT, effect))
    return sources


def _rows(effects: Array) -> Array:
    """Return the smallest number of rows with the same matrix ``effects.T @ effects``."""
    _, size, rows = np.linalg.svd(effects, full_matrices=False)
    kept = size > 1e-9 * max(float(size[0]), 1e-30)
    return np.asarray(size[kept, None] * rows[kept])


def independent(raw: xr.Dataset, readings: Readings, spreads: list[Scatter]) -> Array:
    """Return the variance of a mean that is independent from target to target, (freedom, target)."""
    at_target = per_freedom(raw, "target_uncertainty", len(spreads))
    variances = []
    for x, spread, u in zip(readings.x, spreads, at_target, strict=True):
        n = np.isfinite(x).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            of_mean = spread.own_factor * spread.own / n
        measured = n.any(axis=1)
        variances.append(of_mean[measured].sum(axis=0) / measured.sum() ** 2 + u**2)
    return np.array(variances)
