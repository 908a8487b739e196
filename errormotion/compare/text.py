"""A comparison as text: verdict, and causes with their sizes in printed units."""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np
import xarray as xr

from errormotion.arrays import Array

LIMIT = 0.05
"""Probability below which datasets contradict each other."""
FIELD = {"m": (1e3, "mm"), "rad": (648000 / np.pi, "arcsec"), "s": (1.0, "s"), "1": (1.0, "")}
UM_BELOW = 1e-3
"""Lengths below are printed in um (errors), others in mm (coordinates), m."""
FIELD |= {"m/K": (1e6, "um/K"), "rad/K": (648000 / np.pi, "arcsec/K")}
FIELD |= {"m/s": (3600e6, "um/h"), "rad/s": (3600 * 648000 / np.pi, "arcsec/h")}


MAX_SHARED = 6
"""Number of shared sources that are listed."""


class Spread(NamedTuple):
    """One component of the spread of a freedom, as text."""

    freedom: str
    kind: str
    value: str
    interval: str
    stated: str
    p: str
    unit: str


def spreads(ds: xr.Dataset) -> list[Spread]:
    """Return repeatability and reproducibility of a comparison with groups; empty without groups."""
    if "spread" not in ds.variables:
        return []
    texts = []
    for k, freedom in enumerate(str(name) for name in ds["dof"].values):
        factor, unit = (1e6, "um") if freedom in ("EX", "EY", "EZ") else FIELD["rad"]
        for i, kind in enumerate(str(name) for name in ds["kind"].values):
            value, low, high, stated = (
                factor * float(ds[name].values[i, k])
                for name in ("spread", "spread_low", "spread_high", "spread_stated")
            )
            if np.isfinite(value):
                p = probability(float(ds["spread_p"].values[i, k]))
                interval = f"{low:.3g} to {high:.3g}"
                texts.append(Spread(freedom, kind, f"{value:.3g}", interval, f"{stated:.3g}", p, unit))
        common = factor * float(ds["common"].values[k])
        if np.isfinite(common):
            texts.append(Spread(freedom, "shared by all", "", "", f"{common:.3g}", "", unit))
    return texts


SPREAD_HEAD = ["freedom", "standard deviation", "found", "95 % interval", "stated", "p", "unit"]


class CauseText(NamedTuple):
    """One cause, as text; ``size`` is empty for a cause without a size."""

    name: str
    size: str
    ratio: float
    p: float
    alike: str

    @property
    def sized(self) -> str:
        """Return the cause with its size, if it has one."""
        return f"{self.name} {self.size}" if self.size else self.name


def probability(p: float) -> str:
    """Return a probability as text."""
    if not np.isfinite(p):
        return "unknown"
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}" if p < 0.01 else f"{p:.2f}"


def within(en: Array) -> tuple[str, str]:
    """Return the share of normalised errors within 1, and the largest one, as text; ``unknown`` if none is known."""
    known = np.abs(en[np.isfinite(en)])
    if not known.size:
        return "unknown", "unknown"
    return f"{100 * np.mean(known <= 1):.0f} %", f"{known.max():.2f}"


def _p(p: float) -> str:
    text = probability(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def verdict(ds: xr.Dataset) -> list[str]:
    """Return the result of a comparison as sentences, the most important one first."""
    names = [str(name) for name in ds["dataset"].values]
    p = float(ds.attrs["fit_p"])
    lines = []
    if not np.isfinite(p):
        lines.append("No conclusion is possible: no value is known with an uncertainty in all datasets.")
    elif p >= LIMIT:
        lines.append(f"The {len(names)} datasets agree within their uncertainties ({_p(p)}).")
    else:
        ratio = float(ds.attrs["birge_ratio"])
        lines.append(
            f"The {len(names)} datasets contradict each other ({_p(p)}): their differences are {ratio:.1f} "
            "times as large as their uncertainties allow."
        )
        alone = [name for name, each in zip(names, ds["rest_p"].values, strict=True) if each >= LIMIT]
        if len(names) > 2:
            lines += [f"Without '{name}' the others agree." for name in alone]
        if len(names) > 2 and not alone:
            lines.append("The contradiction remains if any single dataset is left out.")
    searched = np.atleast_1d(ds.attrs.get("searched", np.zeros(ds.sizes["pair"])))
    for j, pair in enumerate(ds["pair"].values):
        first = cause_text(ds, j, 0)
        if first is None:
            if searched[j] and float(ds["p"].values[j]) < LIMIT:
                lines.append(f"{pair}: none of the known causes explains the difference better than chance.")
        elif first.p < 1e-3:
            lines.append(f"{pair}: no single cause explains the difference; the nearest is {first.sized}.")
        elif first.alike:
            lines.append(f"{pair}: possible causes, which these data cannot distinguish: {first.sized}; {first.alike}.")
        else:
            lines.append(f"{pair}: most likely cause: {first.sized}.")
    if shared := _shared(ds):
        more = f" and {len(shared) - MAX_SHARED} more" if len(shared) > MAX_SHARED else ""
        lines.append(f"Treated as fully correlated between datasets: {'; '.join(shared[:MAX_SHARED])}{more}.")
    return lines


def _shared(ds: xr.Dataset) -> list[str]:
    """Return the shared sources: their certificate, or the name of the result of a calibration."""
    keys = json.loads(ds.attrs.get("shared_sources", "[]"))
    names = json.loads(ds.attrs.get("shared_names", "[]")) or keys
    hashed = zip(keys, names, strict=True)
    return [f"{name} (one calibration)" if key.startswith("sha256:") else key for key, name in hashed]


def cause_text(ds: xr.Dataset, pair: int, rank: int) -> CauseText | None:
    """Return a cause of a pair as text; None if there is no cause of this rank."""
    at = {"pair": pair, "rank": rank}
    one = ds[["cause", "alike", "size", "size_u", "size_name", "cause_p", "log_likelihood_ratio"]].isel(at)
    name = str(one["cause"].values)
    if not name:
        return None
    parts = []
    for label, value, u in zip(one["size_name"].values, one["size"].values, one["size_u"].values, strict=True):
        if str(label) and np.isfinite(value):
            what, _, unit = str(label).removesuffix(")").rpartition(" (")
            factor, field = FIELD.get(unit, (1.0, unit))
            if unit == "m" and abs(value) < UM_BELOW:
                factor, field = 1e6, "um"
            spread = f" ± {2 * factor * u:.2g}" if np.isfinite(u) else ""
            parts.append(f"{what} {factor * value:.4g}{spread} {field}".rstrip())
    return CauseText(
        name, ", ".join(parts), float(one["log_likelihood_ratio"]), float(one["cause_p"]), str(one["alike"].values)
    )
