"""The result of a comparison as a dataset, schema ``errormotion.comparison/1``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.compare.comparable import ComparableErrors
from errormotion.compare.consensus import Consensus
from errormotion.compare.diagnosis import Cause
from errormotion.compare.pairs import Pair
from errormotion.compare.repeats import KINDS, Repeats
from errormotion.compare.stack import shared
from errormotion.datasets.checks import matrix_violations
from errormotion.errors import DatasetError

SCHEMA = "errormotion.comparison/1"
CAUSES = 5
"""Number of causes that are stored for each pair."""

#: Variable to its dimensions (``...``: the common dimension, if there is one), and its meaning.
TABLE: dict[str, tuple[tuple[str, ...], str]] = {
    "value": (("dataset", "...", "dof"), "errors of each dataset on common ground; m, rad"),
    "covariance": (("dataset", "...", "dof", "dof_"), "their total covariance; m^2, m rad, rad^2"),
    "difference": (("pair", "...", "dof"), "first less second dataset of a pair; m, rad"),
    "difference_covariance": (
        ("pair", "...", "dof", "dof_"),
        "covariance of the difference; shared sources are one draw",
    ),
    "en": (("pair", "...", "dof"), "normalised error: difference over its expanded uncertainty (k = 2)"),
    "chi2": (("pair",), "joint chi-square of the difference over all points and freedoms"),
    "degrees": (("pair",), "its degrees of freedom"),
    "p": (("pair",), "probability of a larger chi-square if both agree"),
    "curve_chi2": (("pair", "dof"), "joint chi-square of one freedom over all points"),
    "curve_degrees": (("pair", "dof"), "its degrees of freedom"),
    "curve_p": (("pair", "dof"), "probability of a larger one if both agree"),
    "consensus": (("...", "dof"), "generalised least squares of all datasets; m, rad"),
    "consensus_covariance": (("...", "dof", "dof_"), "covariance of the consensus"),
    "robust": (("...", "dof"), "mean with a variance between datasets (DerSimonian and Laird); m, rad"),
    "robust_uncertainty": (("...", "dof"), "its standard uncertainty; m, rad"),
    "between": (("dof",), "standard deviation between datasets (tau); m, rad"),
    "misfit_p": (("dataset",), "probability that a dataset departs so far from the others, after Holm"),
    "rest_p": (
        ("dataset",),
        "probability of the residuals of the others without this dataset; NaN below two",
    ),
    "cause": (("pair", "rank"), "causes that could explain the difference, the most likely one first"),
    "cause_p": (("pair", "rank"), "probability of a larger rest if it is the only cause"),
    "log_likelihood_ratio": (("pair", "rank"), "of the cause, against agreement"),
    "size": (("pair", "rank", "parameter"), "size of the cause; SI"),
    "size_u": (("pair", "rank", "parameter"), "its standard uncertainty; SI"),
    "size_name": (("pair", "rank", "parameter"), "what the size is, and its unit"),
    "alike": (("pair", "rank"), "causes that these data cannot tell from it"),
}


#: Variables of a comparison with groups; all of them or none.
REPEATS: dict[str, tuple[tuple[str, ...], str]] = {
    "group": (("dataset",), "what the datasets are grouped by: test, operator, instrument or method"),
    "spread": (("kind", "dof"), "standard deviation found: repeatability, between groups, reproducibility; m, rad"),
    "spread_low": (("kind", "dof"), "lower end of its interval of 95 %; m, rad"),
    "spread_high": (("kind", "dof"), "upper end; m, rad"),
    "spread_degrees": (("kind", "dof"), "effective degrees of freedom; NaN for a difference of mean squares"),
    "spread_stated": (("kind", "dof"), "standard deviation that the stated uncertainties let expect; m, rad"),
    "spread_p": (("kind", "dof"), "probability of a larger spread if the stated uncertainties are right"),
    "common": (("dof",), "stated standard uncertainty that all groups share and no repeat shows; m, rad"),
}


def build(
    common: ComparableErrors,
    pairs: Sequence[Pair],
    agreed: Consensus,
    robust: tuple[Array, Array, Array],
    causes: Sequence[Sequence[Cause] | None],
    spread: Repeats | None = None,
) -> xr.Dataset:
    """Return the result of a comparison as a dataset of the schema; ``causes`` of a pair are None if not searched."""
    estimates = common.estimates
    found: dict[str, Any] = {
        "value": np.array([each.value for each in estimates]),
        "covariance": np.array([each.covariance() for each in estimates]),
        "difference": np.array([each.difference.value for each in pairs]),
        "difference_covariance": np.array([each.difference.covariance() for each in pairs]),
        "en": np.array([each.en for each in pairs]),
        "chi2": np.array([each.joint.value for each in pairs]),
        "degrees": np.array([each.joint.degrees for each in pairs]),
        "p": np.array([each.joint.p for each in pairs]),
        "curve_chi2": np.array([[one.value for one in each.curve] for each in pairs]),
        "curve_degrees": np.array([[one.degrees for one in each.curve] for each in pairs]),
        "curve_p": np.array([[one.p for one in each.curve] for each in pairs]),
        "consensus": agreed.estimate.value,
        "consensus_covariance": agreed.estimate.covariance(),
        "robust": robust[0],
        "robust_uncertainty": robust[1],
        "between": robust[2],
        "misfit_p": np.array(agreed.p),
        "rest_p": np.array([each.p for each in agreed.rest]),
        **_causes([each or () for each in causes]),
    }
    single = not common.dim
    variables = {}
    for name, (dims, meaning) in TABLE.items():
        values = found[name]
        if "..." in dims and single:
            values = np.take(values, 0, axis=dims.index("..."))
        names = [common.dim if dim == "..." else dim for dim in dims if not (dim == "..." and single)]
        variables[name] = (names, values, {"long_name": meaning})
    if spread is not None:
        groups = {f"spread{end}": getattr(spread, name) for end, name in _SPREAD.items()}
        groups |= {"group": spread.groups, "common": spread.common}
        variables |= {name: (list(dims), groups[name], {"long_name": text}) for name, (dims, text) in REPEATS.items()}
    coords: dict[str, Any] = {
        **({"kind": list(KINDS)} if spread is not None else {}),
        "dataset": [each.name for each in estimates],
        "pair": [f"{each.a} - {each.b}" for each in pairs],
        "dof": list(common.freedoms),
        "dof_": list(common.freedoms),
        "rank": np.arange(1, CAUSES + 1),
        **common.coords,
    }
    attrs: dict[str, Any] = {
        "schema": SCHEMA,
        "component": common.component,
        "machine": common.machine,
        "frame": common.frame,
        "functional_point": common.point,
        "fit_chi2": agreed.fit.value,
        "fit_degrees": agreed.fit.degrees,
        "fit_p": agreed.fit.p,
        "birge_ratio": agreed.birge,
        "shared_sources": json.dumps(shared(estimates)),
        "shared_names": json.dumps([common.labels.get(key, key) for key in shared(estimates)]),
        "notes": common.notes or [""],
        "searched": np.array([each is not None for each in causes], dtype=int),
    }
    if common.since is not None:
        attrs |= {"since": common.since, "start": common.start}
    ds = xr.Dataset(variables, coords=coords, attrs=attrs)
    if wrong := violations(ds):
        raise DatasetError(f"The result of the comparison does not conform to {SCHEMA}:", wrong, code="schema.violated")
    return ds


_SPREAD = {"": "value", "_low": "low", "_high": "high", "_degrees": "degrees", "_stated": "stated", "_p": "p"}


def _causes(causes: Sequence[Sequence[Cause]]) -> dict[str, Any]:
    most = max([1, *(len(cause.sizes) for each in causes for cause in each[:CAUSES])])
    shape = (len(causes), CAUSES)
    variables: dict[str, Any] = {
        "cause": np.full(shape, "", dtype=object),
        "alike": np.full(shape, "", dtype=object),
        "cause_p": np.full(shape, np.nan),
        "log_likelihood_ratio": np.full(shape, np.nan),
        "size": np.full((*shape, most), np.nan),
        "size_u": np.full((*shape, most), np.nan),
        "size_name": np.full((*shape, most), "", dtype=object),
    }
    for i, each in enumerate(causes):
        for rank, cause in enumerate(each[:CAUSES]):
            at = (i, rank)
            variables["cause"][at], variables["alike"][at] = cause.name, "; ".join(cause.alike)
            variables["cause_p"][at], variables["log_likelihood_ratio"][at] = cause.p, cause.log_likelihood_ratio
            for j, size in enumerate(cause.sizes):
                variables["size"][(*at, j)], variables["size_u"][(*at, j)] = size.value, size.standard_uncertainty
                variables["size_name"][(*at, j)] = f"{size.name} ({size.unit})"
    return {name: array.astype(str) if array.dtype == object else array for name, array in variables.items()}


def violations(ds: xr.Dataset) -> list[str]:
    """Return every violation of the schema, one sentence each."""
    messages = [f"attribute '{name}': missing" for name in ("machine", "component", "frame") if name not in ds.attrs]
    table = TABLE | (REPEATS if REPEATS.keys() & set(ds.variables) else {})
    own = {dim for dims, _ in table.values() for dim in dims}
    value = ds.variables.get("value")
    common = [dim for dim in (() if value is None else value.dims) if dim not in own]
    if len(common) > 1:
        messages.append(f"value: expected one common dimension at most; found {', '.join(map(str, common))}")
    for name, (dims, meaning) in table.items():
        if name not in ds.variables:
            messages.append(f"{name}: missing; expected {meaning}")
            continue
        expected = tuple(part for dim in dims for part in (common if dim == "..." else [dim]))
        if ds.variables[name].dims != expected:
            messages.append(f"{name}: expected dims ({', '.join(map(str, expected))}); found {ds.variables[name].dims}")
    for name in ("dataset", "pair", "dof", "dof_", "kind"):
        if name in ds.dims and name not in ds.coords:
            messages.append(f"{name}: missing; expected its labels")
    messages = messages or _wrong_types(ds, table) or _wrong_covariances(ds)
    if not messages:
        for name in ("p", "curve_p", "misfit_p", "rest_p", *(["spread_p"] if "spread_p" in ds.variables else [])):
            values = ds.variables[name].values
            if values.dtype.kind != "f" or ((values < 0) | (values > 1)).any():
                messages.append(f"{name}: expected probabilities from 0 to 1")
    return messages


_TEXTS = ("cause", "size_name", "alike", "group")


def _wrong_types(ds: xr.Dataset, table: Mapping[str, Any]) -> list[str]:
    messages = []
    for name in table:
        variable = ds.variables[name]
        expected, kinds = ("text", "UO") if name in _TEXTS else ("numbers", "fiu")
        if variable.size and variable.dtype.kind not in kinds:
            messages.append(f"{name}: expected {expected}; found {variable.dtype}")
    return messages


def _wrong_covariances(ds: xr.Dataset) -> list[str]:
    messages = []
    for values, name in _COVARIANCES.items():
        messages += matrix_violations(name, ds.variables[name].values, np.isnan(ds.variables[values].values))
    for name in ("robust_uncertainty", "between", "size_u"):
        if (ds.variables[name].values < 0).any():
            messages.append(f"{name}: expected standard uncertainties of 0 or more")
    return messages


_COVARIANCES = {
    "value": "covariance",
    "difference": "difference_covariance",
    "consensus": "consensus_covariance",
}
