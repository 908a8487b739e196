"""The result of a Monte Carlo evaluation as a dataset, schema ``errormotion.monte_carlo/1``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets import hash_dataset
from errormotion.datasets.results.places import place_of
from errormotion.datasets.schemas import DOF
from errormotion.datasets.storage.compression import as_stored
from errormotion.errors import DatasetError
from errormotion.montecarlo.adaptive import Summary
from errormotion.montecarlo.validation import NOT_VALIDATED, UNDECIDED, VALIDATED, WORDS, Validation

SCHEMA = "errormotion.monte_carlo/1"
_END = ("...", "dof", "limit")
_ONE = ("...", "dof")
TABLE: dict[str, tuple[tuple[str, ...], str]] = {
    "linear": (_ONE, "estimate by the method; m, rad"),
    "linear_uncertainty": (_ONE, "its standard uncertainty by linear propagation"),
    "mean": (_ONE, "mean of the trials"),
    "uncertainty": (_ONE, "standard deviation of the trials: the standard uncertainty"),
    "symmetric": (_END, "probabilistically symmetric coverage interval"),
    "shortest": (_END, "shortest coverage interval"),
    "standard_error": (_END, "of the ends of the symmetric interval, by the finite number of trials"),
    "distance": (_END, "of the ends of the linear interval from the symmetric one: d_low, d_high"),
    "tolerance": (_ONE, "numerical tolerance of the standard uncertainty"),
    "verdict": (_ONE, "1: the linear interval is validated; 0: it is not; -1: the trials do not decide"),
    "stable": (_ONE, "1: the adaptive procedure found the results stable"),
    "missing": (_ONE, "trials without a value"),
}
"""Variables: dimensions, ``...`` those of the error dataset, and meaning."""
LABELS = {"dof": (*DOF, "deviation"), "limit": ("low", "high")}
ATTRIBUTES = ("method", "method_version", "machine", "component", "frame", "functional_point", "reference", "sign")
NUMBERS = ("trials", "probability", "digits", "seed")


def build(
    errors: xr.Dataset,
    where: Mapping[str, NDArray[np.intp]],
    linear: Array,
    u: Array,
    summary: Summary,
    validation: Validation,
    seed: int,
    sources: Sequence[str],
    reasons: Mapping[str, int],
) -> xr.Dataset:
    """Return the dataset of an evaluation.

    Parameters
    ----------
    errors : Dataset
        The result that was evaluated.
    where : mapping
        Indices of the places along each dimension.
    linear, u : ndarray (place, dof)
        Estimates and standard uncertainties by linear propagation.
    summary : Summary
    validation : Validation
    seed : int
    sources : sequence of str
        Names of the drawn sources.
    reasons : mapping of str to int
        Number of trials without a result, by reason.

    Raises
    ------
    DatasetError
        The result does not conform to the schema.
    """
    dims, names = [str(dim) for dim in errors.em.dims], list(errors.em.names)
    shape = (*(len(where[dim]) for dim in dims), len(names))
    known = np.isfinite(linear.ravel())
    ends = {
        "symmetric": summary.symmetric,
        "shortest": summary.shortest,
        "standard_error": summary.standard_error,
        "distance": np.stack([validation.low, validation.high]),
    }
    ones = {
        "linear": linear.ravel(),
        "linear_uncertainty": u.ravel(),
        "mean": summary.mean,
        "uncertainty": summary.uncertainty,
        "tolerance": summary.tolerance,
    }
    flags: dict[str, NDArray[Any]] = {
        "verdict": np.where(known, validation.verdict, UNDECIDED).astype(np.int8),
        "stable": summary.stable.astype(np.int8),
        "missing": np.where(known, summary.missing, 0).astype(np.int64),
    }
    variables: dict[str, Any] = {
        name: ((*dims, "dof", "limit"), np.where(known, values, np.nan).T.reshape(*shape, 2))
        for name, values in ends.items()
    }
    variables |= {
        name: ((*dims, "dof"), np.where(known, values, np.nan).reshape(shape)) for name, values in ones.items()
    }
    variables |= {name: ((*dims, "dof"), values.reshape(shape)) for name, values in flags.items()}
    places = errors[names].isel({dim: where[dim] for dim in dims})
    own = {name: places[name].variable for name in places.coords if set(map(str, places[name].dims)) <= set(dims)}
    refused = int(summary.missing[known].max(initial=0))
    notes = [f"{count} trials failed: {reason}" for reason, count in sorted(reasons.items())]
    if refused and not notes:
        notes = [f"{refused} trials had no value at some places."]
    thinned = [f"{len(where[dim])} of {errors.sizes[dim]} places along {dim} were evaluated."
               for dim in dims if len(where[dim]) < errors.sizes[dim]]  # fmt: skip
    attrs = {name: errors.attrs[name] for name in ATTRIBUTES if name in errors.attrs}
    attrs |= {
        "schema": SCHEMA,
        "trials": summary.trials,
        "probability": summary.probability,
        "digits": summary.digits,
        "seed": seed,
        "sources": list(sources),
        "errors_hash": hash_dataset(as_stored(errors)),
        "notes": [*notes, *thinned] or [""],
    }
    ds = xr.Dataset(variables, coords={**own, "dof": names, "limit": ["low", "high"]}, attrs=attrs)
    for name, (_, meaning) in TABLE.items():
        ds[name].attrs["long_name"] = meaning
    if wrong := violations(ds):
        raise DatasetError(
            f"The result of the Monte Carlo evaluation does not conform to {SCHEMA}:",
            wrong,
            code="schema.violated",
        )
    return ds


def violations(ds: xr.Dataset) -> list[str]:
    """Return every violation of the schema, one sentence each."""
    messages = [f"attribute '{name}': missing" for name in (*ATTRIBUTES[:5], *NUMBERS) if name not in ds.attrs]
    linear = ds.variables.get("linear")
    own = [] if linear is None else [str(dim) for dim in linear.dims if dim != "dof"]
    for name, (dims, meaning) in TABLE.items():
        if name not in ds.variables:
            messages.append(f"{name}: missing; expected {meaning}")
            continue
        expected = tuple(part for dim in dims for part in (own if dim == "..." else [dim]))
        if ds.variables[name].dims != expected:
            messages.append(f"{name}: expected dims ({', '.join(expected)}); found {ds.variables[name].dims}")
        if ds.variables[name].dtype.kind not in "iuf":
            messages.append(f"{name}: expected numbers; found {ds.variables[name].dtype}")
    for name, known in LABELS.items():
        labels = [str(label) for label in np.ravel(ds.coords[name].values)] if name in ds.coords else []
        if not labels or len(set(labels)) < len(labels) or not set(labels) <= set(known):
            messages.append(
                f"{name}: expected labels of {', '.join(known)}, each once; found {', '.join(labels) or 'none'}"
            )
    for name in NUMBERS:
        stated = ds.attrs.get(name, 0)
        if not isinstance(stated, int | float | np.number) or not np.isfinite(stated):
            messages.append(f"attribute '{name}': expected a number; found {stated!r:.80}")
    if not messages and not np.isin(ds["verdict"].values, (VALIDATED, NOT_VALIDATED, UNDECIDED)).all():
        messages.append("verdict: expected 1, 0 or -1")
    return messages


@dataclass(frozen=True)
class Line:
    """Results of one freedom.

    Attributes
    ----------
    name : str
    verdict : int
        Verdict of the worst place.
    linear_uncertainty, uncertainty, tolerance : float
        Values at the place where the intervals differ most relative to the tolerance; m or rad.
    distance : float
        Larger distance of the two ends at this place.
    linear, interval : tuple of float
        Ends of both intervals at this place.
    place : str
        Name of this place; empty if there is only one.
    open_places, places : int
        Number of places that are not validated or undecided, and number of all places.
    """

    name: str
    verdict: int
    linear_uncertainty: float
    uncertainty: float
    tolerance: float
    distance: float
    linear: tuple[float, float]
    interval: tuple[float, float]
    place: str
    open_places: int
    places: int

    @property
    def word(self) -> str:
        """Verdict as text."""
        return WORDS[self.verdict]


def lines(ds: xr.Dataset) -> list[Line]:
    """Return one line for each freedom that has values."""
    from scipy.special import ndtri

    own = [str(dim) for dim in ds["linear"].dims if dim != "dof"]
    factor = float(ndtri(0.5 + float(ds.attrs["probability"]) / 2))
    rows = []
    for name in map(str, ds["dof"].values):
        one = ds.sel(dof=name)
        y, u, tolerance, verdict = (
            one[key].values.ravel() for key in ("linear", "linear_uncertainty", "tolerance", "verdict")
        )
        moving = np.isfinite(y) & ((u > 0) | (one["uncertainty"].values.ravel() > 0))
        if not moving.any():
            continue
        worst = verdict[moving]
        value = NOT_VALIDATED if (worst == NOT_VALIDATED).any() else int(worst.min())
        distance = one["distance"].transpose(*own, "limit").values.reshape(-1, 2).max(axis=1)
        ratio = np.where(moving, distance / np.maximum(tolerance, 1e-300), -1.0)
        ratio[np.isnan(ratio)] = -0.5
        candidates = np.where(moving & (verdict == value), ratio, -1.0)
        at = int(np.argmax(candidates))
        low, high = one["symmetric"].transpose(*own, "limit").values.reshape(-1, 2)[at]
        place = place_of(one, own, np.unravel_index(at, [one.sizes[dim] for dim in own]) if own else ())
        rows.append(
            Line(name, value, float(u[at]), float(one["uncertainty"].values.ravel()[at]), float(tolerance[at]),
                 float(distance[at]), (float(y[at] - factor * u[at]), float(y[at] + factor * u[at])),
                 (float(low), float(high)), place, int((worst != VALIDATED).sum()), int(moving.sum()))
        )  # fmt: skip
    return rows
