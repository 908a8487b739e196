"""Kinds of files that strangers may have altered: good ones, the commands that read them, and their alterations."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import altered
import file_trials
import h5py
from altered import JSON, TEXT, TOML, Alteration
from altered_datasets import NETCDF, ZARR
from file_trials import Ended
from text_files import DRIFT, DRIFT_MAP, LOG, MAP
from warm_ups import warm_up

from errormotion import datasets, plugins
from errormotion.datasets.files.containers import check_netcdf
from errormotion.errors import DatasetError
from errormotion.plugins import load_object

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
GOOD = ROOT / "tests" / "data" / "datasets"
CAMPAIGN = """schema = "errormotion.campaign/1"
name = "Warm-up"
bench = "bench.toml"
[timeline]
start = "2026-03-02T06:00:00+00:00"
schedule = [{ at = "1 min", spindle_speed = "12000 /min" }]
[[test]]
name = "monday"
method = "normal_vector"
[test.settings]
duration = "20 min"
interval = "10 min"
balls = [
    { name = "B1", centre = ["400 mm", "-720 mm", "120 mm"] },
    { name = "B2", centre = ["3600 mm", "-675 mm", "500 mm"] },
    { name = "B3", centre = ["3500 mm", "720 mm", "200 mm"] },
    { name = "B4", centre = ["400 mm", "675 mm", "620 mm"] },
]
"""
BENCH = """schema = "errormotion.bench/1"
name = "Files"
machine = "VM1"
[instruments.device]
driver = "{driver}"
address = "replay://{file}"
"""
TOLERANCES = """schema = "errormotion.tolerances/1"
[tolerances]
rule = "iso 14253-1"
[tolerances.figures]
"*" = "10 um"
[tolerances.freedoms]
EX = "20 um"
EC = { upper = "50 urad" }
"""
FIGURE = "EZ after*"


@dataclass(frozen=True)
class Kind:
    """Files of one kind: their folders, and what is done with them.

    Attributes
    ----------
    name : str
        What the page calls it.
    alterations : sequence
        What may be done to the file.
    cases : sequence of (folder, target, commands)
        A folder of good files, the altered one, and commands that read it; run in a copy of the folder.
    """

    name: str
    alterations: Sequence[Alteration]
    cases: Sequence[tuple[Path, str, Sequence[Sequence[str]]]]


@dataclass(frozen=True)
class Outcome:
    """One mutation: what was done, with which command, how it ended, and what must not be."""

    kind: str
    number: int
    what: str
    words: tuple[str, ...]
    ended: Ended
    faults: tuple[str, ...]


def trial(kind: Kind, number: int, seed: int, place: Path) -> Outcome:
    """Alter a file in a copy of its folder, and run a command on it."""
    chance = random.Random(f"{seed} {kind.name} {number}")
    source, target, commands = kind.cases[number % len(kind.cases)]
    words = commands[number // len(kind.cases) % len(commands)]
    folder = place / "files"
    copied(source, folder)
    what = altered.alter(folder / target, kind.alterations, chance)
    size = sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())
    ended = file_trials.run(words, folder, place / "log")
    faults = file_trials.faults(ended, names(target), size, stated(folder / target)) + file_trials.harm(folder)
    return Outcome(kind.name, number, what, tuple(words), ended, tuple(faults))


def stated(path: Path) -> int:
    """Return the bytes of values that a NetCDF file states, as far as it may; 0 for another file."""
    if path.suffix != ".nc" or not altered.is_plain(path):  # opening a pipe would not end
        return 0
    try:
        check_netcdf(path)
        with h5py.File(path) as file:
            return sum(each.size * each.dtype.itemsize for each in file.values() if isinstance(each, h5py.Dataset))
    except (DatasetError, OSError, KeyError, RuntimeError, TypeError, ValueError):
        return 0


def copied(source: Path, folder: Path) -> None:
    """Copy a folder to the place of another one."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder, symlinks=True)


def names(target: str) -> tuple[str, ...]:
    """Return names by which a message may call an altered file: its own, or that of the store or run that it is in."""
    parts = Path(target).parts
    labels = [f"'{Path(target).stem}'", "'monday'"]  # of a comparison
    labels += ["log.csv: "] * (target == "map.toml")  # a line of the log that does not fit the map
    labels += ["has no NC programs"] * (target == "bench.toml")  # whatever the bench
    labels += [" in 0 runs. "] * (Path(target).name == "run.json")  # of this machine
    return (*(part for part in parts if part not in ("runs", "errors")), *labels)


class Library:
    """Good files, each made by the commands of the project in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def new(self, name: str, **texts: str) -> Path:
        """Return a new folder with texts in it; double underscores stand for the point of a name."""
        made = self.folder / name
        made.mkdir(parents=True)
        for key, text in texts.items():
            (made / key.replace("__", ".")).write_text(text, encoding="utf-8")
        return made

    def command(self, folder: Path, *words: str) -> None:
        """Run a command that must succeed."""
        ended = file_trials.run(words, folder, self.folder / "log")
        if ended.code:
            raise RuntimeError(f"{words} fails on good files: {ended.answer} {ended.log}")


def subjects() -> dict[str, tuple[str, object]]:
    """Return the subjects of the conformance kit of every method: id of the method and subject by name."""
    found = {}
    for plugin in plugins.available("methods"):
        stated = plugins.get("methods", plugin.id).conformance
        made = load_object(stated) if isinstance(stated, str) else stated()
        for each in made if isinstance(made, tuple) else (made,):
            found[f"{plugin.id} {each.name}".strip()] = (plugin.id, each)
    return found


def texts(library: Library) -> list[Kind]:
    """Return the kinds of files that people write: benches, campaigns, settings, tolerances, maps, logs, tables."""
    benches, campaigns = [], []
    for each in sorted(EXAMPLES.glob("virtual_*")):
        folder = library.folder / each.name
        shutil.copytree(each, folder)
        name = next(file.name for file in sorted(folder.glob("*.toml")) if file.name != "bench.toml")
        checks = [("validate", name), ("run", "--dry-run", name), ("program", name, "--out", "programs")]
        benches.append(
            (folder, "bench.toml", [("bench", "validate", "bench.toml"), ("validate", "bench.toml"), *checks])
        )
        campaigns.append((folder, name, checks))
    logs = library.new("log", log__csv=LOG, map__toml=MAP)
    drift = library.new("drift log", log__csv=DRIFT, map__toml=DRIFT_MAP)
    importing = [("import", "log.csv", "--map", "map.toml", "--out", "raw.nc"),
                 ("import", "log.csv", "--map", "map.toml", "--out", "raw.zarr")]  # fmt: skip
    readings = library.new("readings")
    shutil.copy(EXAMPLES / "check_bar" / "scheme2_0deg_compensated.csv", readings / "readings.csv")
    read = [("validate", "readings.csv"), ("identify", "readings.csv", "--out", "errors.nc")]
    cells = ",".join(["0.1", "0.2", "", "0.15"] * 8)
    heights = library.new("heights", heights__csv="\n".join([cells] * 30),
                          bench__toml=BENCH.format(driver="profile_files", file="heights.csv") +
                          'unit = "mm"\nx_pitch = "10 um"\ny_pitch = "70 um"\n')  # fmt: skip
    rows = [f"S{k},{i},{1500 + 100 * k + 7 * i:.4f},20.{i},1013.2,45" for k in range(3) for i in range(5)]
    head = "station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]\n"
    tracker = library.new("tracker table", lengths__csv=head + "\n".join(rows) + "\n",
                          bench__toml=BENCH.format(driver="tracker_table", file="lengths.csv"))  # fmt: skip
    probe = [("bench", "probe", "bench.toml")]
    return [
        Kind("bench", TOML, benches),
        Kind("campaign", TOML, campaigns),
        Kind("map of an import", TOML, [(logs, "map.toml", importing), (drift, "map.toml", importing)]),
        Kind("log", TEXT, [(logs, "log.csv", importing), (drift, "log.csv", importing)]),
        Kind("readings (CSV)", TEXT, [(readings, "readings.csv", read)]),
        Kind("height map (CSV)", TEXT, [(heights, "heights.csv", probe)]),
        Kind("tracker table", TEXT, [(tracker, "lengths.csv", probe)]),
    ]


def results(library: Library) -> list[Kind]:
    """Return the kinds of results that need no raw data: error datasets, comparisons, tolerances, calibrations."""
    errors, compared = [], []
    for file in sorted(GOOD.glob("*.nc")):
        folder = library.new(f"result {file.stem}", tolerances__toml=TOLERANCES)
        name = "comparison.nc" if file.stem == "comparison" else "errors.nc"
        shutil.copy(file, folder / name)
        both = [("report", name, "--out", "page.html"), ("validate", name)]
        if file.stem == "comparison":
            compared.append((folder, name, both))
            continue
        with datasets.load(file) as good:
            datasets.save(good.assign(EX=good["EX"] + 1e-7), folder / "other.nc")
        more = [("compare", name, "other.nc", "--report", "page.html"),
                ("report", name, "--tolerances", "tolerances.toml"),
                ("compare", name, "other.nc", "--same-start", "--out", "comparison.nc")]  # fmt: skip
        errors.append((folder, name, [*both, *more]))
    judged = [("report", "errors.nc", "--tolerances", "tolerances.toml"), ("validate", "tolerances.toml")]
    tolerances = [(folder, "tolerances.toml", judged) for folder, _, _ in errors]
    calibration = "calibrations/lk-h050.nc"
    read = [("validate", calibration), ("run", "--dry-run", "campaign.toml"), ("report", calibration),
            ("plan", "campaign.toml")]  # fmt: skip
    return [
        Kind("error dataset", NETCDF, errors),
        Kind("comparison", NETCDF, compared),
        Kind("tolerances", TOML, tolerances),
        Kind("calibration", NETCDF, [(library.folder / "virtual_beam", calibration, read)]),
    ]


def runs(library: Library) -> list[Kind]:
    """Return the kinds of files of runs, raw data, and what is made from them; all of them are measured first."""
    folder = library.new("campaign", campaign__toml=CAMPAIGN)
    shutil.copy(EXAMPLES / "virtual_probing" / "bench.toml", folder)
    library.command(folder, "run", "campaign.toml")
    (run,) = (folder / "runs").glob("*-monday-*")
    at = f"runs/{run.name}"
    machine = json.loads((run / "run.json").read_text())["bench"]["machine"]
    library.command(folder, "note", at, "collision")
    library.command(folder, "history", "runs", "--machine", machine, "--figure", FIGURE, "--out", "history.nc")
    follow = ("history", "runs", "--machine", machine, "--figure", FIGURE, "--report", "page.html")
    on_run = [("report", at), ("validate", at), ("runs", "runs"), follow, ("truth", at, "--out", "truth.nc"),
              ("compare", at, "other", "--report", "page.html"), ("identify", at, "--out", "errors.nc")]  # fmt: skip
    shutil.copytree(run, folder / "other")
    other = next((folder / "other").glob("errors/*/errors.nc"))
    with datasets.load(other) as good:
        moved = good.assign(EX=good["EX"] + 1e-7)
    datasets.save(moved, other, overwrite=True)
    halted = library.folder / "halted campaign"
    shutil.copytree(folder, halted)
    state = json.loads((halted / at / "run.json").read_text()) | {"status": "acquired", "errors": None, "report": None}
    (halted / at / "run.json").write_text(json.dumps(state))
    shutil.rmtree(halted / at / "errors")
    shutil.rmtree(halted / "other")
    resume = [("run", "--resume", "--runs", "runs")]
    raws, made = [], []
    for name, (method, subject) in subjects().items():
        place = library.new(f"raw {name}")
        raw = subject.make(1)[0]
        datasets.save(raw, place / "raw.zarr")
        datasets.save(raw, place / "raw.nc")
        for file, alterations in (("raw.zarr", ZARR), ("raw.nc", NETCDF)):
            words = [("validate", file), ("identify", file, "--out", "errors.nc", "--method", method)]
            (raws if alterations is ZARR else made).append((place, file, words))
    thermal = library.new("thermal model")
    for number in (1, 2):
        datasets.save(warm_up(number), thermal / f"warm{number}.nc")
    library.command(thermal, "model", "fit", "warm1.nc", "warm2.nc", "--out", "model.nc")
    predict = [("model", "predict", "model.nc", "warm1.nc", "--out", "errors.nc"), ("validate", "model.nc"),
               ("model", "check", "model.nc", "warm2.nc", "--report", "page.html"), ("report", "model.nc")]  # fmt: skip
    trials = library.new("Monte Carlo")
    shutil.copytree(run / "raw.zarr", trials / "raw.zarr")
    library.command(trials, "identify", "raw.zarr", "--out", "errors.nc", "--monte-carlo", "100", "--scheduler", "sync")
    (evaluation,) = {each.name for each in trials.glob("*.nc")} - {"errors.nc"}
    return [
        Kind("run.json", JSON, [(folder, f"{at}/run.json", on_run), (halted, f"{at}/run.json", resume)]),
        Kind("notes of a run", TEXT, [(folder, f"{at}/events.jsonl", [("report", at), ("runs", "runs"), follow])]),
        Kind("index of runs", JSON, [(folder, "runs/.errormotion-index.json", [("runs", "runs"), follow])]),
        Kind("raw store (Zarr)", ZARR, [*raws, (folder, f"{at}/raw.zarr", [on_run[0], on_run[1], on_run[-1]]),
                                        (halted, f"{at}/raw.zarr", resume)]),
        Kind("raw dataset (NetCDF)", NETCDF, made),
        Kind("history", NETCDF, [(folder, "history.nc", [("report", "history.nc"), ("validate", "history.nc")])]),
        Kind("Monte Carlo evaluation", NETCDF, [(trials, evaluation, [("report", "errors.nc"), ("validate", evaluation),
                                                                      ("report", evaluation)])]),
        Kind("thermal model", NETCDF, [(thermal, "model.nc", predict)]),
        Kind("errors for a thermal model", NETCDF, [(thermal, "warm1.nc", [
            ("model", "fit", "warm1.nc", "warm2.nc", "--out", "new.nc"), predict[0]])]),
    ]  # fmt: skip


MAKERS: tuple[Callable[[Library], list[Kind]], ...] = (texts, results, runs)
