"""Compare the results of two versions of errormotion, to prove that a change of the code does not change results.

    python tools/compare_results.py make OUT                      simulate and measure every example, identify all of it
    python tools/compare_results.py make OUT --raw OLD            identify the raw data stored in OLD again
    python tools/compare_results.py make OUT --raw OLD --generate --measure
                                                                  the same, and also simulate and measure again
    python tools/compare_results.py compare OLD NEW               compare bit for bit
    python tools/compare_results.py compare OLD NEW --within 1e-9 compare within this fraction of a standard uncertainty

``make`` uses the errormotion of the Python interpreter that runs it. It writes:

``raw/``        inputs, and ``raw/index.json``: method and settings of each
``generated/``  raw data and true errors of the kit's subjects, seeds 0 to 2 (without --raw, or with --generate)
``errors/``     the error dataset of each input, the plans, and the thermal model of the probing campaigns
``digests.json``  SHA-256 of each variable and attribute of each raw dataset as loaded, the errors of failed items, and
                the digests of the campaigns measured with simulated devices (without --raw, or with --measure)

``compare`` needs no errormotion. Names, dims, dtypes, values (NaN equal to NaN) and attributes of variables and
coordinates are compared, JSON in attributes key by key. The attributes of ``LEFT_OUT`` and of ``--ignore`` are omitted
and counted. ``--wording`` accepts another wording of the attributes of ``PROSE``, if the numbers in the text are the
same. The exit code is 1 if anything differs, or if an item is in only one folder.

With ``--within``, a difference is divided by the standard uncertainty: from ``covariance`` (EX to EC, ``covariance``,
``influence``), from ``NAME_uncertainty`` or ``NAME_covariance`` (other variables), or, without a stated one, by the
largest absolute value of the variable. ``--by-group`` compares the effects of all sources of a group together, for
versions that have them as other sources. Integers, truth values, texts and the pattern of NaN must always be equal.
Earlier names of groups of sources equal the present ones.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

SEEDS = (0, 1, 2)
TABLE_OF_GROUPS = Path(__file__).parents[1] / "errormotion" / "datasets" / "groups.py"
GROUPS: dict[str, str] = {}
"""Earlier names of groups of sources, and the present ones; read when they are needed."""
CAMPAIGNS = (
    *("virtual_cframe/campaign", "virtual_beam/campaign", "virtual_tracker/campaign", "virtual_gantry/campaign"),
    *("virtual_probing/monday", "virtual_probing/tuesday", "virtual_probing/friday"),
)
CAMPAIGN_TIMEOUT = 900
"""s"""
VARIANTS: dict[str, list[dict[str, Any]]] = {
    "spindle_drift-drift-0": [{"noise": "stated", "compensate_frame": False}],
    "virtual_cframe-campaign-drift": [{"beams": "nominal", "average": 5.0}],
    "beam_direction-0": [{"robust": False}, {"ordered": False}, {"noise": "stated"}],
    "virtual_beam-campaign-beam": [{"compensation": None}],
    "multilateration-0": [
        {"robust": False, "noise": "stated"},
        {"together": True},
        {"drift": "none", "parametric": False},
        {"repeatability": 1e-6, "repeatability_uncertainty": 5e-7},
    ],
    "normal_vector-0": [{"interpolate": False}, {"reference": "first", "robust": False}],
    "virtual_probing-monday-monday": [{"procedure": "normals"}],
    "crossbeam_scan-scan-0": [
        {"strain": "guided"},
        {"strain": "rigid", "line_effects": False},
        {"registration": "paper"},
        {"registration": "open3d_plane"},
    ],
}
"""Further settings for the identification of an input, to compare more of each method."""

LEFT_OUT = {
    "provenance.software.*": "versions of Python and of packages; the version of errormotion changes",
    "@start": "time stamp of a campaign with simulated devices",
    "@clock.*": "clocks of a campaign with simulated devices",
    "provenance.steps.*.campaigns.*": "hash of an error dataset, versions included; the dataset itself is compared",
    "provenance.steps.*.model": "hash of a thermal model, versions included; the model itself is compared",
}
NOT_REPRODUCIBLE = {
    "errors/crossbeam_scan-scan-0-variant2.nc": 1e-6,
    "errors/crossbeam_scan-scan-0-variant3.nc": 1e-6,
}
"""Datasets that one version does not reproduce bit for bit, and the fraction of a standard uncertainty for their
comparison: Open3D registers with several threads, and the order of its sums varies. Two runs differ by up to 2e-8."""
PROSE = (
    *("notes", "notes.*", "reference", "comment", "description", "title", "*.unseen", "*.unseen.*"),
    *("*.long_name", "*.description", "*.comment", "provenance.steps.*"),
)
DOF = ("EX", "EY", "EZ", "EA", "EB", "EC")


# --- make ------------------------------------------------------------------------------------------------------------


def simulated() -> Iterator[tuple[str, str, dict[str, Any], Any]]:
    """Yield name, method, settings and ``make(seed) -> (raw, truth)`` of each conformance subject of a built-in method.

    Only this function depends on the modules with the simulated raw data.
    """
    from errormotion import plugins
    from errormotion.testing.run import subjects_of

    for method in sorted(plugin.id for plugin in plugins.available("methods")):
        for subject in subjects_of("methods", method):
            yield f"{method}/{subject.name}".rstrip("/"), method, jsonable(subject.settings), subject.make


def make(out: Path, raw: Path | None, generate: bool, measure_anew: bool) -> None:
    """Write the results into a folder; see the docstring of this file."""
    import errormotion
    from errormotion import datasets

    out.mkdir(parents=True)
    began = time.time()
    print(f"errormotion of {Path(errormotion.__file__).parent}", flush=True)
    if generate or raw is None:
        simulate(out / "generated")
    if raw is None:
        collect(out)
    source = (raw or out) / "raw"
    os.environ["ERRORMOTION_CALIBRATIONS"] = str((source / "calibrations").resolve())
    digests: dict[str, Any] = {"raw": {}, "measured": {}}
    if raw is None or measure_anew:
        folder = source if raw is None else out / "measured"
        measured = measure(folder) if measure_anew and raw else json.loads((source / "index.json").read_text())
        for name, item in measured.items():
            if item["file"].endswith("raw.zarr") and "-variant" not in name:
                with datasets.load(folder / item["file"]) as dataset:
                    digests["measured"][name] = {"digests": digests_of(dataset)}
        if raw is not None:
            shutil.rmtree(folder)
    for name, item in json.loads((source / "index.json").read_text()).items():
        report = identify(out, source / item["file"], name, item)
        digests["raw"][name] = report
        print(f"{time.time() - began:6.0f} s  {name}: {report.get('failed') or 'identified'}", flush=True)
    (out / "errors" / "model").mkdir(parents=True)
    thermal_model(out / "errors")
    (out / "digests.json").write_text(json.dumps(digests, indent=1))


def simulate(folder: Path) -> None:
    """Store raw data and truth of each conformance subject, with method and settings of their identification."""
    from errormotion import datasets

    index = {}
    for name, method, settings, subject in simulated():
        for seed in SEEDS:
            stem = f"{name.replace('/', '-')}-{seed}"
            raw, truth = subject(seed)
            folder.mkdir(exist_ok=True)
            datasets.save(raw, folder / f"{stem}.nc")
            datasets.save(truth, folder / f"{stem}-truth.nc")
            index[stem] = {"method": method, "settings": settings, "file": f"{stem}.nc", "plan": seed == 0}
    (folder / "index.json").write_text(json.dumps(index, indent=1))


def collect(out: Path) -> None:
    """Collect all inputs in ``out/raw``: simulated raw data, the CSV files, and campaigns with simulated devices."""
    import errormotion

    examples = Path(errormotion.__file__).parents[1] / "examples"
    folder = out / "raw"
    folder.mkdir()
    index = json.loads((out / "generated" / "index.json").read_text())
    for file in {item["file"] for item in index.values()}:
        shutil.copy(out / "generated" / file, folder)
    for file in sorted((examples / "check_bar").glob("*.csv")):
        shutil.copy(file, folder)
        index[f"check_bar-{file.stem}"] = {"method": "beam_direction", "settings": {}, "file": file.name}
    shutil.copytree(examples / "virtual_beam" / "calibrations", folder / "calibrations")
    index |= measure(folder)
    for name, variants in VARIANTS.items():
        for number, changes in enumerate(variants):
            settings = index[name]["settings"] | changes
            index[f"{name}-variant{number}"] = index[name] | {"settings": settings, "plan": False}
    (folder / "index.json").write_text(json.dumps(index, indent=1))


def measure(folder: Path) -> dict[str, Any]:
    """Run the demo and all campaigns in a folder; return method and settings for their raw data."""
    import errormotion

    examples = Path(errormotion.__file__).parents[1] / "examples"
    index: dict[str, Any] = {}
    commands = {name: ["run", str(examples / f"{name}.toml"), "--yes", "--no-report"] for name in CAMPAIGNS}
    for name, command in ({"demo": ["demo"]} | commands).items():
        began, runs = time.time(), folder / name.replace("/", "-")
        errormotion_command(*command, "--runs", str(runs))
        print(f"{time.time() - began:6.0f} s for the campaign {name}", flush=True)
        for run in sorted(path.parent for path in runs.glob("*/run.json")):
            data = json.loads((run / "run.json").read_text())
            index[f"{runs.name}-{data['test']}"] = {
                "method": data["method"]["id"],
                "settings": data["settings"],
                "file": str((run / "raw.zarr").relative_to(folder)),
                "plan": name != "demo",
            }
    return index


def identify(out: Path, raw: Path, name: str, item: dict[str, Any]) -> dict[str, Any]:
    """Store the errors of one input, and its plan if stated; return the digests and failures."""
    from errormotion import datasets, plugins
    from errormotion.errors import ErrormotionError

    method = plugins.get("methods", item["method"])
    report: dict[str, Any] = {}
    for folder in ("errors", "errors/plan")[: 1 + bool(item.get("plan"))]:
        (out / folder).mkdir(exist_ok=True)
        try:
            settings = method.Settings.model_validate(item["settings"])
            if folder == "errors":
                with datasets.load(raw) as dataset:
                    report["digests"] = digests_of(dataset)
                    errors = method().identify(dataset, settings)
            else:
                errors = method().plan(settings)
        except (ErrormotionError, ImportError, ValueError) as error:  # an item may fail, if it fails in both trees
            report["failed"] = f"{folder}: {type(error).__name__}"
            print(f"    {name}: {error}")
        else:
            datasets.save(errors, out / folder / f"{name}.nc")
    return report


def thermal_model(errors: Path) -> None:
    """Store a thermal model of two probing campaigns, and its prediction for the third."""
    monday, tuesday, friday = (errors / f"virtual_probing-{day}-{day}.nc" for day in ("monday", "tuesday", "friday"))
    model = errors / "model" / "model.nc"
    errormotion_command("model", "fit", str(monday), str(tuesday), "-o", str(model))
    errormotion_command("model", "predict", str(model), str(friday), "-o", str(model.with_name("predicted.nc")))


def errormotion_command(*arguments: str) -> None:
    """Run the command line of the errormotion under test."""
    # -P: the working folder may contain another errormotion
    command = [sys.executable, "-P", "-m", "errormotion", *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=CAMPAIGN_TIMEOUT)


def jsonable(value: Any) -> Any:
    """Return settings as values of JSON."""
    return json.loads(json.dumps(value, default=lambda item: item.tolist() if hasattr(item, "tolist") else dict(item)))


def digests_of(ds: xr.Dataset) -> dict[str, str]:
    """Return the SHA-256 of each variable (name, dims, dtype, values) and of each attribute."""
    found = {}
    for name, variable in ds.variables.items():
        kind = "text" if variable.dtype.kind in "OSUT" else variable.dtype.str
        digest = hashlib.sha256(repr((variable.dims, variable.shape, kind)).encode())
        step = max(1, 2**22 * max(variable.shape[:1], default=1) // max(variable.size, 1))
        for start in range(0, max(variable.shape[:1], default=1), step):
            values = np.asarray(variable[start : start + step] if variable.ndim else variable)
            digest.update(repr(values.tolist()).encode() if kind == "text" else values.tobytes())
        found[str(name)] = digest.hexdigest()
    for path, value in attributes(ds).items():
        found[f"@{path}"] = hashlib.sha256(repr(value).encode()).hexdigest()
    return found


# --- compare ---------------------------------------------------------------------------------------------------------


class Difference:
    """Differences of two datasets, omitted attributes, and the largest difference in standard uncertainties."""

    def __init__(self, within: float | None, ignore: tuple[str, ...], wording: bool, by_group: bool = False) -> None:
        self.within, self.ignore, self.wording, self.by_group = within, ignore, wording, by_group
        self.found: list[str] = []
        self.left_out: Counter[str] = Counter()
        self.reworded: list[str] = []
        self.largest = 0.0
        self.compared = 0

    def reports(self, old: dict[str, Any], new: dict[str, Any]) -> Difference:
        """Compare the digests of two raw datasets, and the failures of their identification."""
        if old.get("failed") != new.get("failed"):
            self.found.append(f"{old.get('failed') or 'done'} became {new.get('failed') or 'done'}")
        a, b = old.get("digests", {}), new.get("digests", {})
        for key in sorted(set(a) | set(b)):
            if any(fnmatch(key, pattern) for pattern in self.ignore):
                self.left_out[key] += 1
                continue
            self.compared += 1
            if a.get(key) != b.get(key):
                self.found.append(f"{key}: values differ" if key in a and key in b else f"{key}: in one only")
        return self

    def datasets(self, old: xr.Dataset, new: xr.Dataset) -> Difference:
        """Compare all variables, coordinates and attributes."""
        for name in sorted(set(old.variables) ^ set(new.variables), key=str):
            self.found.append(f"{name}: only in {'OLD' if name in old.variables else 'NEW'}")
        if set(old.coords) ^ set(new.coords):
            self.found.append(f"coordinates: {sorted(map(str, set(old.coords) ^ set(new.coords)))}")
        for name in sorted(set(old.variables) & set(new.variables), key=str):
            self.compared += 1
            self._variable(str(name), old, new)
        self._attributes(attributes(old), attributes(new))
        return self

    def _variable(self, name: str, old: xr.Dataset, new: xr.Dataset) -> None:
        a, b = old.variables[name], new.variables[name]
        if self.by_group and "source" in a.dims and "source" in b.dims:
            if a.dtype.kind == "f":
                self._groups(name, old, new)
            return
        if name == "source_group":
            before, after = ([present_group(str(each)) for each in v.values] for v in (a, b))
            if before != after:
                self.found.append(f"{name}: {sorted(set(before))} became {sorted(set(after))}")
            return
        if (a.dims, a.shape, a.dtype) != (b.dims, b.shape, b.dtype):
            self.found.append(f"{name}: {a.dims} {a.shape} {a.dtype} became {b.dims} {b.shape} {b.dtype}")
            return
        x, y = a.values, b.values
        if x.dtype.kind != "f":
            if not np.array_equal(x, y):
                self.found.append(f"{name}: {np.count_nonzero(np.asarray(x != y))} of {x.size} values differ")
            return
        unknown = np.isnan(x)
        if not np.array_equal(unknown, np.isnan(y)):
            self.found.append(f"{name}: NaN in other positions")
            return
        # -0.0 and 0.0 are also different
        differ = ~unknown & ((x != y) | (np.signbit(x) != np.signbit(y)))
        if not differ.any():
            return
        scale = np.broadcast_to(uncertainty(name, old), x.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(x == y, 0.0, np.abs(y - x) / scale)
        worst = float(np.max(ratio[differ]))
        self.largest = max(self.largest, worst)
        if self.within is None or not worst <= self.within:
            self.found.append(f"{name}: {differ.sum()} of {x.size} values differ, at most {worst:.3g} uncertainties")

    def _groups(self, name: str, old: xr.Dataset, new: xr.Dataset) -> None:
        """Compare the uncertainty by each group of sources, however many these are."""
        before, after = (by_group(name, ds) for ds in (old, new))
        total = sum(np.square(u) for u in before.values())
        scale = np.sqrt(np.where(total > 0, total, np.nanmax(total, initial=0.0)))
        for group in sorted(set(before) | set(after)):
            a, b = before.get(group, 0.0 * scale), after.get(group, 0.0 * scale)
            if np.shape(a) != np.shape(b):
                self.found.append(f"{name}, {group}: {np.shape(a)} became {np.shape(b)}")
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                worst = float(np.nanmax(np.where(a == b, 0.0, np.abs(b - a) / scale), initial=0.0))
            self.largest = max(self.largest, worst)
            if self.within is None or worst > self.within:
                self.found.append(f"{name}, {group}: differs by at most {worst:.3g} of that of all sources")

    def _attributes(self, old: dict[str, Any], new: dict[str, Any]) -> None:
        for path in sorted(set(old) | set(new)):
            if any(fnmatch(path, pattern) for pattern in self.ignore):
                self.left_out[path] += 1
                continue
            a, b = old.get(path), new.get(path)
            if a == b or (isinstance(a, float) and isinstance(b, float) and self._close(a, b)):
                continue
            if self.wording and any(fnmatch(path, pattern) for pattern in PROSE) and numbers(a) == numbers(b):
                self.reworded.append(path)
            else:
                self.found.append(f"attribute {path}: {short(a)} became {short(b)}")

    def _close(self, a: float, b: float) -> bool:
        return (a != a and b != b) or (self.within is not None and abs(a - b) <= self.within * max(abs(a), abs(b)))


def present_group(name: str) -> str:
    """Return the present name of a group of sources; the table of the source tree, which needs no installation."""
    if not GROUPS:
        GROUPS.update(runpy.run_path(str(TABLE_OF_GROUPS))["ALIASES"])
    return GROUPS.get(name, name)


def by_group(name: str, ds: xr.Dataset) -> dict[str, Any]:
    """Return the root sum of squares of the effects of the sources of each group, by its present name."""
    effects = np.moveaxis(ds.variables[name].values, ds.variables[name].dims.index("source"), 0)
    groups = np.array([present_group(str(each)) for each in ds.variables["source_group"].values])
    return {str(group): np.sqrt(np.square(effects[groups == group]).sum(axis=0)) for group in np.unique(groups)}


def uncertainty(name: str, ds: xr.Dataset) -> Any:
    """Return the standard uncertainty by which a difference of a variable is divided, of a shape that broadcasts."""
    values = ds.variables[name].values
    largest = np.nanmax(np.abs(values), initial=0.0)
    if {"covariance", *DOF} <= set(ds.variables):
        u = np.sqrt(np.einsum("...ii->...i", ds.variables["covariance"].values))
        most = np.nanmax(u.reshape(-1, 6), axis=0, initial=0.0)
        u = np.where(u > 0, u, most)  # the reference state has none of its own
        if name in DOF and values.shape == u.shape[:-1]:
            return u[..., DOF.index(name)]
        if name == "covariance":
            return u[..., :, None] * u[..., None, :]
        if name == "influence":
            return u
    if f"{name}_uncertainty" in ds.variables and ds.variables[f"{name}_uncertainty"].shape == values.shape:
        u = ds.variables[f"{name}_uncertainty"].values
        return np.where(u > 0, u, largest)
    if f"{name}_covariance" in ds.variables:
        u = np.sqrt(np.abs(np.einsum("...ii->...i", ds.variables[f"{name}_covariance"].values)))
        if u.shape == values.shape:
            return np.where(u > 0, u, largest)
    return largest


def attributes(ds: xr.Dataset) -> dict[str, Any]:
    """Return all attributes by path: of the dataset, of its variables (``variable.attribute``), and within JSON."""
    found: dict[str, Any] = {}
    for name, value in ds.attrs.items():
        found |= flat(str(name), value)
    for variable in ds.variables:
        for name, value in ds.variables[variable].attrs.items():
            found |= flat(f"{variable}.{name}", value)
    return found


def flat(path: str, value: Any) -> dict[str, Any]:
    """Return the leaves of a value by path; a text that is a JSON object or array is entered."""
    if isinstance(value, str) and value[:1] in ("{", "["):
        try:
            value = json.loads(value)
        except ValueError:
            return {path: value}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict) and value:
        return {k: v for key in value for k, v in flat(f"{path}.{key}", value[key]).items()}
    if isinstance(value, list | tuple) and value:
        return {k: v for i, item in enumerate(value) for k, v in flat(f"{path}.{i}", item).items()}
    return {path: value}


def numbers(value: Any) -> list[str]:
    """Return the numbers in a text."""
    return sorted(re.findall(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?", str(value or "")))


def short(value: Any) -> str:
    """Return a value as a text of limited length."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."


def compare(
    old: Path, new: Path, within: float | None, ignore: list[str], wording: bool, by_group: bool, details: int
) -> int:
    """Print one line for each dataset and return 1 if anything differs, else 0."""
    left_out, reworded, different, total = Counter[str](), 0, 0, 0
    print(f"{'dataset':58} {'compared':>8} {'left out':>8} {'reworded':>8} {'max |d|/u':>10}  result")
    for name, difference in pairs(old, new, Difference, within, (*LEFT_OUT, *ignore), wording, by_group):
        total += 1
        different += bool(difference.found)
        left_out += difference.left_out
        reworded += len(difference.reworded)
        counts = f"{difference.compared:8} {difference.left_out.total():8} {len(difference.reworded):8}"
        equal = "equal" if difference.within is None else f"within {difference.within:g}"
        print(f"{name:58} {counts} {difference.largest:10.2g}  {'DIFFERENT' if difference.found else equal}")
        for line in difference.found[:details]:
            print(f"    {line}")
        if len(difference.found) > details:
            print(f"    and {len(difference.found) - details} more")
    print(f"\n{total} datasets, {different} different; {left_out.total()} attributes left out, {reworded} reworded")
    for path, count in sorted(left_out.items()):
        reason = next((why for pattern, why in LEFT_OUT.items() if fnmatch(path, pattern)), "--ignore")
        print(f"  left out {count:4} x {path} ({reason})")
    if not total:
        print("nothing to compare")
    return int(bool(different) or not total)


def pairs(old: Path, new: Path, *difference: Any) -> Iterator[tuple[str, Difference]]:
    """Yield the comparison of every dataset in one of two folders; generated data only if both have them."""
    kind, *options = difference
    a, b = (json.loads((folder / "digests.json").read_text()) for folder in (old, new))
    for part in ["raw"] + ["measured"] * bool(a["measured"] and b["measured"]):
        for name in sorted(set(a[part]) | set(b[part])):
            reports = [found[part].get(name, {"failed": "missing"}) for found in (a, b)]
            yield f"{part}/{name}", kind(*options).reports(*reports)
    folders = ["errors"] + ["generated"] * ((old / "generated").exists() and (new / "generated").exists())
    for folder in folders:
        files = [{str(file.relative_to(path)) for file in (path / folder).rglob("*.nc")} for path in (old, new)]
        for name in sorted(files[0] | files[1]):
            result = kind(*options)
            if name in NOT_REPRODUCIBLE:
                result.within = max(result.within or 0.0, NOT_REPRODUCIBLE[name])
            if name in files[0] & files[1]:
                with opened(old / name) as x, opened(new / name) as y:
                    result.datasets(x, y)
            else:
                result.found.append(f"only in {'OLD' if name in files[0] else 'NEW'}")
            yield name, result


def opened(path: Path) -> xr.Dataset:
    """Open a NetCDF file without decoding of numbers and times."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return xr.open_dataset(
            path,
            engine="h5netcdf",
            mask_and_scale=False,
            decode_times=False,
            decode_timedelta=False,
            create_default_indexes=False,
        )


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("make", help="store the results of this version")
    one.add_argument("out", type=Path, help="a new folder")
    one.add_argument("--raw", type=Path, help="identify the raw data of this folder, made by an earlier 'make'")
    one.add_argument("--generate", action="store_true", help="with --raw: also simulate the raw data of the kit again")
    one.add_argument("--measure", action="store_true", help="with --raw: also run the campaigns again")
    two = commands.add_parser("compare", help="compare two folders")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    two.add_argument("--within", type=float, help="largest difference, as a fraction of the standard uncertainty")
    two.add_argument("--ignore", action="append", default=[], metavar="PATH", help="attribute to omit, as *.name")
    two.add_argument("--wording", action="store_true", help="accept another wording of notes and descriptions")
    two.add_argument("--by-group", action="store_true", help="compare sources by their groups, however many they are")
    two.add_argument("--details", type=int, default=5, help="differences to print for one dataset")
    given = parser.parse_args()
    if given.command == "make":
        warnings.simplefilter("ignore")
        make(given.out, given.raw, given.generate, given.measure)
        return 0
    for folder in (given.old, given.new):
        if not (folder / "digests.json").exists():
            parser.error(f"{folder}: expected a complete folder of 'make'; found no digests.json")
    return compare(given.old, given.new, given.within, given.ignore, given.wording, given.by_group, given.details)


if __name__ == "__main__":
    sys.exit(main())
