"""Repeats: repeatability within groups of datasets, the variance between groups, and reproducibility, with intervals.

One-way analysis of variance of each freedom (ISO 5725-2), over all points: with N datasets in G groups, ``MS_w`` is
the mean square within groups and ``MS_b`` that of the unweighted group means times the harmonic mean h of the group
sizes. ``E MS_w = s_r^2`` and ``E MS_b = s_r^2 + h s_L^2``. Points share sources, so that they are not
independent repeats: the degrees of freedom are those of Box, ``v (tr S)^2 / tr S^2``, where S is the covariance between
points from the repeats. Intervals are those of chi-square, and modified large-sample intervals for sums and differences
(Burdick and Graybill 1992, Confidence Intervals on Variance Components; Ting et al. 1990).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import special

from errormotion.arrays import Array
from errormotion.compare.stack import Estimate
from errormotion.datasets import provenance
from errormotion.errors import DatasetError

KINDS = ("repeatability", "between groups", "reproducibility")
BY = ("test", "operator", "instrument", "method")
"""Attributes by which datasets can be grouped."""
ENDS = (0.025, 0.975)
"""Probabilities below the ends of the intervals."""

ROUNDING = 1e-9
"""Fraction of a mean square below which a difference is regarded as a rounding error."""


@dataclass(frozen=True)
class Repeats:
    """Standard deviations of each freedom, (kind, d), kinds as in `KINDS`; NaN if unknown.

    Attributes
    ----------
    groups : list of str
        Group of each dataset.
    value, low, high : ndarray
        Standard deviation, with its 95 % interval; m and rad.
    degrees : ndarray
        Effective degrees of freedom; NaN for a difference of mean squares.
    stated : ndarray
        Expected from the stated uncertainties, taking shared sources into account.
    p : ndarray
        Probability of a larger spread if the stated uncertainties are correct.
    common : ndarray, (d,)
        Stated standard uncertainty that all groups share, which repeats do not show.
    """

    groups: list[str]
    value: Array
    low: Array
    high: Array
    degrees: Array
    stated: Array
    p: Array
    common: Array


def labels(datasets: Mapping[str, xr.Dataset], by: str) -> dict[str, str]:
    """Return the group of each dataset by operator, instrument or method.

    Raises
    ------
    DatasetError
        A dataset does not state this.
    """
    if by not in BY[1:]:
        raise DatasetError(f"Expected groups by {', '.join(BY)}; found '{by}'", code="repeats.group.unknown")
    by_name = {name: _label(ds, by) for name, ds in datasets.items()}
    if missing := [name for name, label in by_name.items() if not label]:
        raise DatasetError(
            f"{', '.join(map(repr, missing))}: no {by} is stated, so that it cannot be assigned to a group. "
            + ("The provenance states no serial number" if by == "instrument" else f"Set the attribute '{by}'"),
            code="repeats.group.not_stated",
        )
    return by_name


def _label(ds: xr.Dataset, by: str) -> str:
    if by != "instrument":
        return str(ds.attrs.get(by, "")).strip()
    parts = []
    for entry in provenance.of(ds).get("instruments") or []:
        identity = entry.get("identity") if isinstance(entry, dict) else None
        if isinstance(identity, dict) and identity.get("serial_number"):
            parts.append(" ".join(str(identity[key]) for key in ("model", "serial_number") if identity.get(key)))
    return ", ".join(sorted(parts))


def repeats(estimates: Sequence[Estimate], groups: Sequence[str]) -> Repeats:
    """Return repeatability and reproducibility of datasets on one grid.

    Parameters
    ----------
    estimates : sequence of Estimate
        N estimates, (n, d).
    groups : sequence of str
        Group of each estimate.

    Raises
    ------
    DatasetError
        There are fewer than two datasets.
    """
    if len(estimates) < 2:
        raise DatasetError(f"Repeats need at least two datasets; found {len(estimates)}", code="repeats.too_few")
    names = list(dict.fromkeys(groups))
    number = np.array([names.index(group) for group in groups])
    within, between, h = _contrasts(number, len(names))
    d = estimates[0].value.shape[1]
    rows = {name: np.full((len(KINDS), d), np.nan) for name in ("value", "low", "high", "degrees", "stated", "p")}
    common = np.full(d, np.nan)
    for k in range(d):
        Y = np.array([each.value[:, k] for each in estimates])
        V = _between_datasets(estimates, k)
        moving = np.isfinite(Y).all(axis=0) & (np.einsum("iip->p", np.nan_to_num(V)) > 0)
        if not moving.any():
            continue
        Y, V = Y[:, moving], V[:, :, moving]
        w, b = (_mean_square(B, Y, V) for B in (within, between))
        for name, column in _components(w, b, h).items():
            rows[name][:, k] = column
        apart = number[:, None] != number if len(names) > 1 else ~np.eye(len(Y), dtype=bool)
        common[k] = np.sqrt(max(float(V[apart].mean()), 0.0))
    return Repeats(list(groups), **rows, common=common)


@dataclass(frozen=True)
class _Square:
    """A mean square with its effective degrees of freedom, and its expectation from the stated uncertainties."""

    value: float
    degrees: float
    stated: float


def _contrasts(number: Array, count: int) -> tuple[Array, Array, float]:
    """Return orthonormal contrasts within groups (N - G, N), of group means (G - 1, N), and the harmonic mean h."""
    A = (number == np.arange(count)[:, None]).astype(float)
    size = A.sum(axis=1)
    h = count / float((1.0 / size).sum())
    within = _basis(np.eye(number.size) - A.T @ (A / size[:, None]))
    means = A / size[:, None]
    between = np.sqrt(h) * _basis(np.eye(count) - 1.0 / count) @ means
    return within, between, h


def _basis(projector: Array) -> Array:
    """Return orthonormal rows that span the range of a projector."""
    power, vectors = np.linalg.eigh(projector)
    basis: Array = vectors[:, power > 0.5].T
    return basis


def _mean_square(B: Array, Y: Array, V: Array) -> _Square | None:
    """Return the mean square of contrasts B (v, N) of values Y (N, n) with stated covariance V (N, N, n)."""
    v = len(B)
    if v == 0:
        return None
    E = B @ Y
    gram = E @ E.T / Y.shape[1]
    one, two = float(np.trace(gram)) / v, float((gram**2).sum()) / v**2
    stated = float(np.einsum("vi,ijp,vj->", B, V, B)) / v / Y.shape[1]
    return _Square(one, v * _independent(one, two, v, Y.shape[1]), stated)


def _independent(one: float, two: float, v: int, n: int) -> float:
    """Return the number of independent points equivalent to n points: (tr S)^2 / tr S^2 (Box 1954), S = E'E / v.

    The trace of S^2 includes the scatter of S, so that the number tends to be too small, at most v, and the intervals
    have at least the stated coverage. The scatter of an unbiased estimate would be so large with few repeats that the
    intervals would be too narrow.
    """
    return float(np.clip(one**2 / two, 1.0, n)) if v > 1 and two > 0 else 1.0


def _components(w: _Square | None, b: _Square | None, h: float) -> dict[str, Array]:
    rows = {name: np.full(len(KINDS), np.nan) for name in ("value", "low", "high", "degrees", "stated", "p")}

    def put(kind: int, value: float, interval: tuple[float, float], degrees: float, stated: float, p: float) -> None:
        squares = {"value": value, "low": interval[0], "high": interval[1], "stated": stated}
        for name, square in squares.items():
            rows[name][kind] = np.sqrt(max(square, 0.0))
        rows["degrees"][kind], rows["p"][kind] = degrees, p

    if w is not None:
        put(0, w.value, _chi_square(w.value, w.degrees), w.degrees, w.stated, _larger(w))
    if b is not None and w is None:  # no repeats within a group: only the sum is determined
        put(2, b.value, _chi_square(b.value, b.degrees), b.degrees, b.stated, _larger(b))
    if b is not None and w is not None:
        apart = b.stated - w.stated
        apart = apart if apart > ROUNDING * b.stated else 0.0
        put(1, (b.value - w.value) / h, _difference(b, w, h), np.nan, apart / h, _larger(b))
        parts = [(b, 1 / h), (w, 1 - 1 / h)]
        total = sum(share * component.value for component, share in parts)
        spread = sum((share * component.value) ** 2 / component.degrees for component, share in parts)
        stated = sum(share * component.stated for component, share in parts)
        degrees = total**2 / spread if spread > 0 else np.nan
        # A negative variance between groups is set to 0 (ISO 5725-2).
        put(2, max(total, w.value), _sum(parts), degrees, stated, _larger(_Square(total, degrees, stated)))
    return rows


def _larger(square: _Square) -> float:
    if not square.stated > 0 or not np.isfinite(square.degrees):
        return float("nan")
    return float(special.chdtrc(square.degrees, square.degrees * square.value / square.stated))


def _bounds(degrees: float) -> tuple[float, float]:
    """Return G and H of a mean square: its interval is from (1 - G) to (1 + H) times its value."""
    low, high = (float(2 * special.gammaincinv(degrees / 2, p)) / degrees for p in ENDS)  # of chi-square
    return 1 - 1 / high, 1 / low - 1


def _chi_square(value: float, degrees: float) -> tuple[float, float]:
    G, H = _bounds(degrees)
    return (1 - G) * value, (1 + H) * value


def _sum(parts: Sequence[tuple[_Square, float]]) -> tuple[float, float]:
    """Return the interval of a sum of mean squares with positive weights (Graybill and Wang 1980)."""
    value = sum(share * component.value for component, share in parts)
    G, H = (
        np.sqrt(sum((_bounds(component.degrees)[side] * share * component.value) ** 2 for component, share in parts))
        for side in (0, 1)
    )
    return value - float(G), value + float(H)


def _difference(b: _Square, w: _Square, h: float) -> tuple[float, float]:
    """Return the interval of (MS_b - MS_w) / h (Ting et al. 1990)."""
    low, high = (float(special.fdtri(b.degrees, w.degrees, p)) for p in ENDS)
    (G1, H1), (G2, H2) = _bounds(b.degrees), _bounds(w.degrees)
    G12 = ((high - 1) ** 2 - (G1 * high) ** 2 - H2**2) / high
    H12 = ((1 - low) ** 2 - (H1 * low) ** 2 - G2**2) / low
    x, y = b.value, w.value
    down = (G1 * x) ** 2 + (H2 * y) ** 2 + G12 * x * y
    up = (H1 * x) ** 2 + (G2 * y) ** 2 + H12 * x * y
    return (x - y - float(np.sqrt(max(down, 0.0)))) / h, (x - y + float(np.sqrt(max(up, 0.0)))) / h


def _between_datasets(estimates: Sequence[Estimate], k: int) -> Array:
    """Return the stated covariance between datasets of one freedom at every point, (N, N, n)."""
    n = len(estimates[0].value)
    V = np.zeros((len(estimates), len(estimates), n))
    rows = [dict(zip(estimate.source, estimate.influence[:, :, k], strict=True)) for estimate in estimates]
    for i, estimate in enumerate(estimates):
        for j in range(i + 1):
            shared = rows[i].keys() & rows[j].keys()
            V[i, j] = V[j, i] = sum((rows[i][key] * rows[j][key] for key in sorted(shared)), np.zeros(n))
        V[i, i] += estimate.own[:, k, k]
    return V


def interval_coverage(
    groups: int, size: int, trials: int, seed: int, *, ratio: float = 1.0, points: int = 1, shared: float = 0.0
) -> dict[str, float]:
    """Return the coverage of the intervals by kind, from simulated repeats.

    Parameters
    ----------
    groups, size : int
        Number of groups, and of datasets in each group.
    trials, seed : int
    ratio : float
        Standard deviation between groups divided by that within groups.
    points : int
        Number of points of each dataset.
    shared : float
        Fraction of the variances that all points of a dataset have in common, 0 to 1.
    """
    rng = np.random.default_rng(seed)
    label = [str(k) for k in np.repeat(np.arange(groups), size)]
    truth = np.array([1.0, ratio, np.hypot(1.0, ratio)])
    held = np.zeros(len(KINDS))

    def drawn(rows: int) -> Array:
        one, each = rng.normal(size=(rows, 1)), rng.normal(size=(rows, points))
        return np.asarray(np.sqrt(shared) * one + np.sqrt(1 - shared) * each)

    for _ in range(trials):
        values = ratio * np.repeat(drawn(groups), size, axis=0) + drawn(groups * size)
        made = [
            Estimate(str(i), row[:, None], np.ones((points, 1, 1)), np.zeros((0, points, 1)), ())
            for i, row in enumerate(values)
        ]
        found = repeats(made, label)
        held += (found.low[:, 0] <= truth) & (truth <= found.high[:, 0])
    return dict(zip(KINDS, (held / trials).tolist(), strict=True))
