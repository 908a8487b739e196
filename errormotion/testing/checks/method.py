"""Checks of method plugins; the statistical checks are in ``coverage``."""
# ruff: noqa: D401 - the docstring of a check is its requirement

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Hashable, Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import xarray as xr
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion import datasets, plugins
from errormotion.datasets.schemas import variants
from errormotion.errors import ErrormotionError
from errormotion.kinematics import twists
from errormotion.kinematics.iso import DOF
from errormotion.plugins import MethodInfo, MethodSubject, Needs, kind_registry, states
from errormotion.testing.checks import shared
from errormotion.testing.checks.coverage import coverage, differences, figures, no_figures, recovers_truth
from errormotion.testing.checks.draws import sources_as_stated, sources_drawn, why_no_trial_model
from errormotion.testing.checks.text import chapters_translated, why_no_texts
from errormotion.testing.kit import Checks, require
from errormotion.testing.results import covariance, functional_point, names, raw_data, sigma, values

METHOD_CHECKS: Checks[MethodSubject] = Checks()

#: Two results are equal if they differ by less than this fraction of their standard uncertainty, which allows for
#: rounding of sums in another order and for the last step of an iteration.
SAME = 1e-3
#: The same for data stored with 24 bits, 6e-8 of a reading; noise is rarely smaller than 1e-6 of it.
SAME_SINGLE = 0.1


@METHOD_CHECKS.add()
def info_complete(subject: MethodSubject) -> str:
    """``info`` states id, summary, status, version and what it cannot determine; ``needs`` known kinds and a schema."""
    info, needs = subject.plugin.info, subject.plugin.needs
    shared.check_info(info, MethodInfo, "id")
    blind = isinstance(info.cannot_see, tuple) and all(isinstance(text, str) and text for text in info.cannot_see)
    require(blind, f"info.cannot_see: expected a tuple of sentences, found {info.cannot_see!r}")
    require(isinstance(needs, Needs), f"needs: expected a Needs, found {type(needs).__name__}")
    drivers = (each.cls for each in plugins.available("instruments") if each.cls is not None)
    known = {*kind_registry.kinds(), *(driver.info.kind for driver in drivers)}
    unknown = [kind for kind in needs.instruments if kind not in known]
    require(
        not unknown,
        f"needs.instruments: no kind '{', '.join(unknown)}' is registered, and no instrument has it; expected some of "
        f"{', '.join(sorted(known))}",
    )
    named = needs.raw_schema.startswith("errormotion.raw.") and "/" in needs.raw_schema
    require(named, f"needs.raw_schema: expected 'errormotion.raw.NAME/VERSION', found {needs.raw_schema!r}")
    return f"{info.id} {info.version}, {info.status}"


@METHOD_CHECKS.add()
def settings_strict(subject: MethodSubject) -> str:
    """Settings are a PluginSettings, refuse unknown keys, and are unchanged after a round trip through JSON."""
    return shared.check_settings(subject.plugin.Settings, subject.effective_settings())


@METHOD_CHECKS.add()
def motions_stated(subject: MethodSubject) -> str:
    """A method that can move a machine, by programs or by a kind named in its package, states its motions."""
    plugin = subject.plugin
    if states(plugin, "motions"):
        return "motions are stated"
    name, source = plugin.info.id, Path(str(sys.modules[plugin.__module__].__file__))
    require(not states(plugin, "programs"), f"'{name}' writes NC programs and does not state its motions ('motions')")
    moving = {each for each in kind_registry.kinds() if kind_registry.kind_changes_machine(each)}
    found = sorted(moving & (set(plugin.needs.instruments) | _texts_of(source)))
    named = " and ".join(found)
    require(not found, f"'{name}' uses a {named} and does not state its motions ('motions'); [] for no motion")
    return "no instrument with motions is used"


@lru_cache(maxsize=4)
def _texts_of(source: Path) -> frozenset[str]:
    """Return the texts in the package of a source file, or in the file if it is in no package."""
    in_package = (source.parent / "__init__.py").exists()
    found: set[str] = set()
    for path in source.parent.rglob("*.py") if in_package else [source]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
    return frozenset(found)


@METHOD_CHECKS.add()
def schema(subject: MethodSubject) -> str:
    """Raw data and result conform to their schemas, and the result states its method and settings."""
    raw = raw_data(subject)
    tables = tuple(subject.plugin.raw_schemas)
    if tables or variants(str(raw.attrs.get("schema"))):  # a method without tables validates its raw data itself
        datasets.validate(raw, tables)
    expected = subject.plugin.needs.raw_schema
    require(raw.attrs["schema"] == expected, f"raw data: expected schema {expected}, found {raw.attrs.get('schema')}")
    errors, _ = subject.outcome(0)
    datasets.validate(errors)
    info = subject.plugin.info
    for key, value in {"schema": datasets.SCHEMA, "method": info.id, "method_version": info.version}.items():
        require(errors.attrs[key] == value, f"attribute {key}: expected '{value}', found '{errors.attrs[key]}'")
    provenance = json.loads(errors.attrs["provenance"])
    require(bool(provenance), "attribute provenance is empty")
    known, spread = np.isfinite(values(errors)), np.isfinite(sigma(errors))
    require(bool(known.any()), "no freedom has a value")
    require(bool((known == spread).all()), "a value without an uncertainty, or an uncertainty without a value")
    return f"{known.any(axis=0).sum()} freedoms at {len(known)} points"


@METHOD_CHECKS.add()
def joins_along_a_dimension(subject: MethodSubject) -> str:
    """The parts of an acquisition are joined along a dimension of the raw data, and their expected length is known."""
    method, settings = subject.plugin(), subject.effective_settings()
    dim, length = method.append_dim(settings), method.progress(settings)
    raw = raw_data(subject)
    # Acquired data may be another variant of the schema than the data of the kit.
    known = {str(d) for d in raw.dims}
    tables = method.raw_schemas or variants(method.needs.raw_schema)
    known |= {d for table in tables for row in table.rows for d in row.dims}
    require(dim in known, f"append_dim: expected one of {', '.join(sorted(known))}; found '{dim}'")
    require(0 < length < float("inf"), f"progress: expected a positive length, found {length}")
    return f"{length:g} along {dim}"


@METHOD_CHECKS.add()
def deterministic(subject: MethodSubject) -> str:
    """One seed results in one raw dataset and, bit for bit, one result; another seed in another."""
    raw, (again, _), (other, _) = raw_data(subject), subject.make(0), subject.make(1)
    require(raw.identical(again), "the source of raw data returns two different datasets for one seed")
    require(not raw.identical(other), "the source of raw data ignores the seed")
    np.random.seed(1)  # noqa: NPY002 - a method that leans on the global generator shows itself
    first = subject.identify(raw)
    np.random.seed(2)  # noqa: NPY002
    second = subject.identify(raw)
    differ = [str(name) for name in first.variables if not first[name].identical(second[name])]
    require(not differ, f"two identifications of one raw dataset differ in {', '.join(differ)}")
    return "two equal results"


METHOD_CHECKS.add(limit=60.0)(recovers_truth)
METHOD_CHECKS.add(limit=300.0)(coverage)
METHOD_CHECKS.add(limit=300.0)(differences)
METHOD_CHECKS.add(limit=300.0, why_not=no_figures)(figures)
METHOD_CHECKS.add(limit=60.0, why_not=why_no_trial_model)(sources_drawn)
METHOD_CHECKS.add(limit=300.0, why_not=why_no_trial_model)(sources_as_stated)
METHOD_CHECKS.add(why_not=why_no_texts)(chapters_translated)


@METHOD_CHECKS.add()
def frame_invariance(subject: MethodSubject) -> str:
    """Raw data transformed to another frame result in the same errors and covariance, transformed to that frame."""
    rotation, shift = (np.array(part) for part in subject.motion)
    pose = RigidTransform.from_components(shift, Rotation.from_rotvec(rotation))
    raw = raw_data(subject)
    here, _ = subject.outcome(0)
    there = _moved_subject(subject, pose).identify(moved_raw(raw, subject.raw_vectors, pose))
    if names(here) != DOF:
        return _deviation_invariance(here, there, pose)
    back = np.round(pose.apply(functional_point(here)) - functional_point(there), 12)  # else NaN times rounding is NaN
    turned = twists.adjoint(rotation=pose.rotation)
    expected, spread = twists.transform(values(here), turned), twists.transform_covariance(covariance(here), turned)
    carried = twists.adjoint(shift=back)
    _require_close(
        expected,
        spread,
        twists.transform(values(there), carried),
        twists.transform_covariance(covariance(there), carried),
    )
    return f"{np.isfinite(expected).sum()} equal values"


def _deviation_invariance(here: xr.Dataset, there: xr.Dataset, pose: RigidTransform) -> str:
    """Fail unless the deviations are equal, and their sensitivity is rotated with the frame."""
    expected = here.em.in_frame(pose, "moved").em.at(functional_point(there))["sensitivity"]
    same = expected.sizes == there["sensitivity"].sizes and np.allclose(expected, there["sensitivity"], atol=1e-9)
    require(bool(same), "the sensitivity was not rotated with the frame")
    _require_close(values(here), covariance(here), values(there), covariance(there))
    return f"{np.isfinite(values(here)).sum()} equal values"


def _moved_subject(subject: MethodSubject, pose: RigidTransform) -> MethodSubject:
    moved = dict(subject.settings)
    for name, kind in subject.setting_vectors.items():
        vector = np.asarray(moved[name], dtype=float)
        moved[name] = tuple(pose.apply(vector) if kind == "point" else pose.rotation.apply(vector))
    return replace(subject, settings=moved)


def moved_raw(raw: xr.Dataset, vectors: Any, pose: RigidTransform) -> xr.Dataset:
    """Return a raw dataset with its vectors in another frame."""
    Q, shift = pose.rotation.as_matrix(), pose.translation
    moved = raw.copy(deep=True)
    for name, kind in vectors.items():
        array = moved[name]
        if kind in ("point", "direction"):
            vector = array.transpose(..., "direction")
            data = vector.values @ Q.T + (shift if kind == "point" else 0.0)
            moved[name] = vector.copy(data=data).transpose(*array.dims)
        elif kind == "covariance":
            both = np.kron(np.eye(2), Q)
            moved[name] = array.copy(data=both @ array.values @ both.T)
        elif kind == "pose":
            data = np.eye(4)
            data[:3, :3], data[:3, 3] = Q @ array.values[:3, :3], Q @ array.values[:3, 3]
            moved[name] = array.copy(data=data)
        else:
            axis = "xyz".index(kind)
            require(bool(np.allclose(Q[axis], np.eye(3)[axis])), f"the motion of the subject rotates the axis {kind}")
            moved[name] = array + shift[axis]
        moved[name].attrs = dict(array.attrs)
    return moved


@METHOD_CHECKS.add()
def number_format(subject: MethodSubject) -> str:
    """Measured values stored as float32 result in the same errors, within a tenth of their uncertainty."""
    raw = raw_data(subject)
    single = raw.copy()
    for name in measured_variables(subject, raw):
        single[name] = raw[name].astype(np.float32)
        single[name].attrs = dict(raw[name].attrs)
    one, other = subject.outcome(0)[0], subject.identify(single)
    _require_close(values(one), covariance(one), values(other), covariance(other), fraction=SAME_SINGLE)
    return f"{', '.join(measured_variables(subject, raw))} in single precision"


@METHOD_CHECKS.add()
def units(subject: MethodSubject) -> str:
    """Measured values in mm with this unit result in the same errors or a typed error."""
    raw = raw_data(subject)
    lengths = [name for name in measured_variables(subject, raw) if raw[name].attrs.get("units") == "m"]
    require(bool(lengths), "no measured variable has the attribute units = 'm'")
    straight, verdicts = subject.outcome(0)[0], []
    for name in lengths:
        field = raw.copy()
        field[name] = (raw[name] * 1e3).assign_attrs(units="mm")
        verdicts.append(_same_or_refused(subject, straight, field, f"{name} in mm"))
    return "; ".join(verdicts)


@METHOD_CHECKS.add()
def layout(subject: MethodSubject) -> str:
    """The order of dimensions and of their labels has no effect, or is refused with a typed error."""
    raw = raw_data(subject)
    straight, _ = subject.outcome(0)
    turned = raw.copy()
    for name in map(str, raw.data_vars):
        turned[name] = raw[name].transpose(*reversed(raw[name].dims))
    verdicts = [_same_or_refused(subject, straight, turned, "transposed dimensions")]
    verdicts += [
        _same_or_refused(subject, straight, raw.isel({dim: slice(None, None, -1)}), f"reversed {dim}")
        for dim in _labelled(raw, raw.dims)
    ]
    return "; ".join(verdicts)


def _same_or_refused(subject: MethodSubject, one: xr.Dataset, raw: xr.Dataset, what: str) -> str:
    try:
        other = subject.identify(raw)
    except ErrormotionError:
        return f"{what}: refused"
    other = other.sel({dim: one[dim] for dim in _labelled(one, one["EX"].dims)})
    _require_close(values(one), covariance(one), values(other), covariance(other), what=what)
    return f"{what}: the same"


@METHOD_CHECKS.add(limit=60.0)
def refuses_missing_inputs(subject: MethodSubject) -> str:
    """Without a required variable, or with data of another schema, the method raises a typed error that names it."""
    raw = raw_data(subject)
    for name in map(str, raw.data_vars):
        less = raw.drop_vars(name)
        if name in subject.optional:
            subject.identify(less)
        else:
            _require_typed_refusal(subject, less, f"without '{name}'", names=name)
    foreign = raw.assign_attrs(schema="errormotion.raw.of_another_method/1")
    _require_typed_refusal(subject, foreign, "with data of another schema", names="of_another_method")
    return f"each of {len(raw.data_vars) - len(subject.optional)} variables is required"


@METHOD_CHECKS.add()
def nothing_measured(subject: MethodSubject) -> str:
    """Without any measured value, the method raises a typed error or returns NaN."""
    raw = raw_data(subject)
    blank = raw.copy()
    for name in measured_variables(subject, raw):
        blank[name] = raw[name] * np.nan
        blank[name].attrs = dict(raw[name].attrs)
    try:
        errors = subject.identify(blank)
    except ErrormotionError as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0]}"
    require(not np.isfinite(values(errors)).any(), "finite results without measured values")
    return "all NaN"


@METHOD_CHECKS.add()
def leaves_inputs_alone(subject: MethodSubject) -> str:
    """Identification does not change the raw dataset or its attributes, and accepts read-only arrays."""
    raw = raw_data(subject)
    for variable in raw.variables.values():
        if isinstance(variable.data, np.ndarray):
            variable.data.flags.writeable = False
    before = raw.copy(deep=True)
    attributes = {str(name): dict(raw[name].attrs) for name in raw.variables}
    subject.identify(raw)
    require(before.identical(raw), "the raw dataset was changed")
    changed = [name for name, attrs in attributes.items() if dict(raw[name].attrs) != attrs]
    require(
        not changed and before.attrs == raw.attrs, f"attributes were changed: {', '.join(changed) or 'of the dataset'}"
    )
    return "unchanged"


@METHOD_CHECKS.add(limit=60.0)
def round_trip(subject: MethodSubject) -> str:
    """A result is unchanged after storage; raw data from a file (NetCDF, Zarr) have the same result."""
    raw = raw_data(subject)
    errors, _ = subject.outcome(0)
    with TemporaryDirectory() as folder:
        datasets.save(errors, Path(folder) / "errors.nc")
        loaded = datasets.load(Path(folder) / "errors.nc")
        differ = [str(name) for name in errors.variables if not errors[name].equals(loaded[name])]
        require(not differ, f"changed by storage as NetCDF: {', '.join(differ)}")
        require(loaded.attrs.keys() == errors.attrs.keys(), "attributes were lost or added by storage as NetCDF")
        loaded.close()
        for name in ("raw.nc", "raw.zarr"):
            datasets.save(raw, Path(folder) / name)
            stored = datasets.load(Path(folder) / name)
            again = subject.identify(stored)
            stored.close()
            _require_close(values(errors), covariance(errors), values(again), covariance(again), what=f"from {name}")
    return "result, raw.nc, raw.zarr"


@METHOD_CHECKS.add()
def plan(subject: MethodSubject) -> str:
    """``plan`` returns zeros with the expected covariance, for the same freedoms as ``identify``."""
    planned = subject.plugin().plan(subject.effective_settings())
    datasets.validate(planned)
    expected = np.isfinite(values(subject.outcome(0)[0])).any(axis=0)
    found = np.isfinite(sigma(planned)).any(axis=0)
    seen, planned_for = (", ".join(np.array(names(planned))[which]) for which in (expected, found))
    require(bool((found == expected).all()), f"plan determines {planned_for or 'nothing'}, identification {seen}")
    known = values(planned)
    require(bool((known[np.isfinite(known)] == 0).all()), "planned values are not zero")
    return f"{planned_for}"


def why_nothing_expected(subject: MethodSubject) -> str:
    """Return why a plan cannot be compared with the identification of what it expects; empty if it can."""
    if not states(subject.plugin, "expected"):
        return "the method has no expected raw data (expected)"
    try:
        subject.plugin().expected(subject.effective_settings())
    except NotImplementedError as error:  # of one of several procedures
        return str(error)
    return ""


@METHOD_CHECKS.add(why_not=why_nothing_expected)
def plan_agrees(subject: MethodSubject) -> str:
    """The plan and the identification of the raw data that it expects have the same sources and the same covariance."""
    method, settings = subject.plugin(), subject.effective_settings()
    planned, found = method.plan(settings), method.identify(method.expected(settings), settings)
    groups = [_groups(each) for each in (planned, found)]
    require(
        groups[0] == groups[1],
        f"groups of sources: planned {', '.join(groups[0]) or 'none'}; identified {', '.join(groups[1]) or 'none'}",
    )
    of_plan, of_result = covariance(planned), covariance(found)
    require(of_plan.shape == of_result.shape, "the plan and the result have different places")
    largest = np.sqrt(np.nanmax(np.abs(of_result), initial=0.0, axis=(-2, -1), keepdims=True))
    same = np.isclose(
        of_plan, of_result, rtol=SAME, atol=SAME * float(np.max(largest, initial=0.0)) ** 2, equal_nan=True
    )
    same |= ~np.isfinite(of_plan) | ~np.isfinite(of_result)  # the freedoms are compared by the check "plan"
    require(bool(same.all()), f"the covariances differ at {int((~same).any(axis=(-2, -1)).sum())} places")
    return f"{len(groups[0])} groups: {', '.join(groups[0])}" if groups[0] else "no common sources"


def _groups(errors: xr.Dataset) -> list[str]:
    """Return the groups of the sources of a result."""
    return sorted({str(group) for group in errors["source_group"].values}) if "source_group" in errors else []


def measured_variables(subject: MethodSubject, raw: xr.Dataset) -> tuple[str, ...]:
    """Return the names of the readings: as the subject states, else all arrays of float64 without vectors."""
    if subject.measured:
        return subject.measured
    arrays = {str(name): array for name, array in raw.data_vars.items() if name not in subject.raw_vectors}
    return tuple(name for name, array in arrays.items() if array.ndim > 0 and array.dtype == np.float64)


def _require_typed_refusal(subject: MethodSubject, raw: xr.Dataset, what: str, *, names: str) -> None:
    try:
        subject.identify(raw)
    except ErrormotionError as error:
        require(names in str(error), f"{what}: the message does not name '{names}': {error}")
        return
    except Exception as error:  # noqa: BLE001 - named in the verdict
        require(False, f"{what}: expected an error of errormotion.errors, found {type(error).__name__}: {error}")
    require(False, f"{what}: expected an error, found a result")


def _labelled(dataset: xr.Dataset, dims: Iterable[Hashable]) -> list[str]:
    return [str(dim) for dim in dims if dim in dataset.coords and dataset[dim].dtype.kind in "UOT"]


def _require_close(
    one: np.ndarray,
    spread: np.ndarray,
    other: np.ndarray,
    other_spread: np.ndarray,
    fraction: float = SAME,
    what: str = "",
) -> None:
    """Fail unless two results, (place, n) with covariances, agree to a fraction of their standard uncertainty."""
    require(one.shape == other.shape, f"{what} {one.shape[0]} points became {other.shape[0]}".strip())
    known, known_other = np.isfinite(one), np.isfinite(other)
    require(bool((known == known_other).all()), f"{what} freedoms became known or unknown".strip())
    require(bool(known.any()), "nothing to compare: no freedom is known")
    u = np.sqrt(np.einsum("pii->pi", spread))
    u_other = np.sqrt(np.einsum("pii->pi", other_spread))
    scale = np.max(np.nan_to_num(u), axis=0, keepdims=True)
    for what_differs, difference in {"value": np.abs(one - other), "standard uncertainty": np.abs(u - u_other)}.items():
        ratio = np.where(known, difference, 0.0) / np.where(u > 0, u, np.where(scale > 0, scale, 1.0))
        place, freedom = np.unravel_index(np.argmax(ratio), ratio.shape)
        require(
            ratio.max() <= fraction,
            f"{what} {what_differs} of {DOF[freedom]} at point {place} differs by "
            f"{ratio.max():.2g} of its uncertainty, expected at most {fraction:g}".strip(),
        )
