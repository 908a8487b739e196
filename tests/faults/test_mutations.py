"""A quick form of ``make mutations``: a few altered files of each kind that people write or pass on."""

import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import altered
import altered_datasets
import file_kinds
import file_trials
import numpy as np
import pytest
from file_kinds import Kind, Library

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.compensation.program.reading import offsets
from errormotion.datasets.files import tomlfile
from errormotion.errors import DatasetError, ErrormotionError, RunError
from errormotion.instruments.compensator.offset_file import OffsetFile
from errormotion.instruments.line_profiler.profile_files import ProfileFiles
from errormotion.instruments.transports import recording

FEW = 2
"""Alterations of each kind."""


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> list[Kind]:
    library = Library(tmp_path_factory.mktemp("good"))
    made = [*file_kinds.texts(library), *file_kinds.results(library)]
    source, _, commands = made[-1].cases[0]
    for words in commands[:-1]:  # the last one plans, which takes seconds and imports no more
        file_trials.preload(words, source, library.folder / "log")
    return made


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_altered_files_are_read_or_refused_by_name(tmp_path: Path, kinds: list[Kind]) -> None:
    outcomes = [file_kinds.trial(kind, number, 1, tmp_path) for kind in kinds for number in range(FEW)]
    assert [(each.kind, each.number, each.what, each.faults) for each in outcomes if each.faults] == []
    assert {1, 2, 3} & {each.ended.code for each in outcomes}


def test_internal_errors_markup_and_messages_without_a_name_are_found(tmp_path: Path) -> None:
    ended = file_trials.Ended(file_trials.INTERNAL_ERROR, 0.0, 0, "", "Internal error", "")
    assert file_trials.faults(ended, ["bench.toml"], 0)
    assert file_trials.faults(file_trials.Ended(1, 0.0, 0, "", "no machine", ""), ["bench.toml"], 0)
    assert not file_trials.faults(file_trials.Ended(1, 0.0, 0, "", "bench.toml: no machine", ""), ["bench.toml"], 0)
    assert file_trials.faults(file_trials.Ended(0, 0.0, 1 << 30, "", "", ""), [], 100)
    (tmp_path / "page.html").write_text(f"<p>{altered_datasets.SCRIPT}</p>")
    assert file_trials.harm(tmp_path)


@pytest.fixture(scope="module")
def good_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with datasets.load(file_kinds.GOOD / "spindle_drift_drift.nc") as good:
        return datasets.save(good, tmp_path_factory.mktemp("store") / "errors.zarr")


@pytest.fixture
def store(good_store: Path, tmp_path: Path) -> Path:
    return shutil.copytree(good_store, tmp_path / "errors.zarr")


@pytest.mark.parametrize("number", range(6))
def test_stores_of_zarr_v2_are_refused_and_no_object_is_made(
    store: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(store.parent)
    altered_datasets.zarr_v2(store, random.Random(number))
    with pytest.raises(DatasetError, match="format 3"):
        datasets.load(store)
    assert not (store.parent / "unpickled").exists()


@pytest.mark.parametrize("codec", altered_datasets.CODECS, ids=lambda codec: codec["name"])
def test_codecs_that_make_objects_are_refused(store: Path, codec: dict[str, object]) -> None:
    file = store / "EX" / "zarr.json"
    metadata = json.loads(file.read_text())
    metadata["codecs"] = [codec, codec]
    file.write_text(json.dumps(metadata))
    with pytest.raises(DatasetError, match="EX"):
        datasets.load(store)


def test_links_and_pipes_in_a_store_are_refused(store: Path) -> None:
    chunk = next(each for each in (store / "EX" / "c").rglob("*") if each.is_file())
    chunk.unlink()
    chunk.symlink_to("/etc/passwd")
    with pytest.raises(DatasetError, match="found a link"):
        datasets.load(store)


@pytest.mark.parametrize("name", ["../other", "..", "/etc", "a/b", ""])
def test_names_of_arrays_do_not_lead_out_of_a_store(store: Path, name: str) -> None:
    root = json.loads((store / "zarr.json").read_text())
    held = json.loads((store / "EX" / "zarr.json").read_text())
    root["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": {name: held}}
    (store / "zarr.json").write_text(json.dumps(root))
    with pytest.raises(DatasetError, match="expected a folder of this name"):
        datasets.load(store)


@pytest.mark.parametrize("change", [altered_datasets._enlarge, altered_datasets._link, altered_datasets._external])
def test_netcdf_files_that_are_small_and_state_much_or_lead_elsewhere_are_refused(tmp_path: Path, change) -> None:
    path = tmp_path / "errors.nc"
    shutil.copy(file_kinds.GOOD / "spindle_drift_drift.nc", path)
    for number in range(12):
        try:
            with altered_datasets.h5py.File(path, "r+") as file:
                change(file, random.Random(number))
            break
        except (ValueError, KeyError, RuntimeError):
            continue
    with pytest.raises(DatasetError, match="is damaged"):
        datasets.load(path)


def test_a_file_may_not_state_much_more_than_it_has(tmp_path: Path) -> None:
    path = tmp_path / "errors.nc"
    with altered_datasets.h5py.File(path, "w") as file:
        file["own"] = np.random.default_rng(1).integers(256, size=1_000_000, dtype=np.uint8)
        file.create_dataset("EX", shape=(80_000_000,), chunks=(100_000,), dtype="f8", compression="gzip")
    with pytest.raises(DatasetError, match=r"expected at most 603979776 bytes of values .* it states 641000000"):
        datasets.load(path)


@pytest.mark.slow
def test_reading_takes_at_most_five_copies_of_the_values_that_a_file_states(tmp_path: Path) -> None:
    good, rows = datasets.load(file_kinds.GOOD / "spindle_drift_drift.nc").load(), 40_000
    many = good.isel(time=np.zeros(rows, int)).assign_coords(time=("time", np.arange(float(rows)), good["time"].attrs))
    for variable in many.variables.values():
        variable.encoding = {}
    packed = {str(name): {"zlib": True} for name in many.variables if many[name].dtype.kind == "f"}
    commands = (["validate", "errors.nc"], ["report", "errors.nc", "--out", "page.html"])
    shutil.copy(file_kinds.GOOD / "spindle_drift_drift.nc", tmp_path / "errors.nc")
    for words in commands:
        file_trials.preload(words, tmp_path, tmp_path / "log")
    many.to_netcdf(tmp_path / "errors.nc", engine="h5netcdf", encoding=packed)
    for words in commands:
        ended = file_trials.run(words, tmp_path, tmp_path / "log")
        assert ended.code == 0, ended.answer
        assert ended.memory <= 5 * sum(each.nbytes for each in many.variables.values())


@pytest.mark.parametrize(
    "text",
    [
        "x = " + "[" * 20_000 + "]" * 20_000,
        "x = " + "{a = " * 20_000 + "1" + "}" * 20_000,
        ".".join(["x"] * 20_000) + " = 1",
        "[" + ".".join(["x"] * 20_000) + "]",
        "x = " + "9" * 10_000,
        "x = " + "[" * 40 + "]" * 40,
    ],
    ids=["arrays", "tables", "key", "name of a table", "digits", "40 levels"],
)
def test_deep_toml_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(DatasetError, match=r"bench\.toml: "):
        tomlfile.read_toml(path)


@pytest.mark.parametrize("text", ["[" * 20_000, "9" * 10_000, '{"schema": "errormotion.run/1", "steps": 5}', '"x"'])
def test_run_files_with_other_content_are_refused_by_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(RunError, match=r"run\.json"):
        RunFolder.open(tmp_path)


def test_keys_that_a_run_file_lacks_are_named(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"schema": "errormotion.run/1", "bench": {}}')
    with pytest.raises(RunError, match=r"run\.json: expected the key 'text'"):
        RunFolder.open(tmp_path).data["bench"]["text"]


@pytest.mark.parametrize("name", ["raw.zarr", "errors.nc"])
def test_links_do_not_lead_out_of_a_run_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text('{"schema": "errormotion.run/1", "errors": "errors.nc"}')
    (tmp_path / "run" / name).symlink_to(tmp_path / "elsewhere")
    folder = RunFolder.open(tmp_path / "run")
    with pytest.raises(RunError, match="expected a file in this folder"):
        _ = folder.raw if name == "raw.zarr" else folder.errors


@pytest.mark.timeout(30)
def test_an_alteration_does_not_follow_what_another_has_put_in_place(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.write_text("x = 1")

    def put(path: Path, chance: random.Random) -> str:
        path.unlink()
        if chance.random() < 0.5:
            os.mkfifo(path)
        else:
            path.symlink_to(outside)
        return "put"

    for number in range(40):
        (folder := tmp_path / str(number)).mkdir()
        (folder / "a.toml").write_text("x = 1")
        altered.alter(folder / "a.toml", [put, altered.bytes_of, altered.text], random.Random(number))
    assert outside.read_text() == "x = 1"


def test_pipes_and_devices_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.nc")
    (tmp_path / "device.toml").symlink_to("/dev/zero")
    with pytest.raises(DatasetError, match="not a regular file"):
        datasets.load(tmp_path / "pipe.nc")
    with pytest.raises(DatasetError, match="not a regular file"):
        tomlfile.read_toml(tmp_path / "device.toml")


@pytest.mark.timeout(30)
@pytest.mark.parametrize(
    "read",
    [
        recording.read_recording,
        recording.read_index,
        recording.parts_of,
        recording.read_note,
        offsets.read_tools,
        lambda path: ProfileFiles(f"replay://{path}").open(),
        lambda path: OffsetFile(str(path)).open(),
    ],
    ids=["recording", "index", "parts", "note", "tools", "list of scans", "offset"],
)
def test_pipes_do_not_stop_a_reader(tmp_path: Path, read: Callable[[Path], object]) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ErrormotionError, match="not a regular file"):
        read(tmp_path / "pipe")


@pytest.mark.parametrize("change", ["negative", "asymmetric", "not positive", "gap"])
def test_covariances_of_a_comparison_are_checked(change: str) -> None:
    good = datasets.load(file_kinds.GOOD / "comparison.nc").load()
    C = good["covariance"].values.copy().reshape(-1, 6, 6)
    known = next(each for each in C if np.isfinite(each).all() and each[0, 0] * each[1, 1] > 0)
    match change:
        case "negative":
            known[2, 2] *= -1.0
        case "asymmetric":
            known[0, 1] += np.sqrt(known[0, 0] * known[1, 1])
        case "not positive":
            known[0, 1] = known[1, 0] = 2.0 * np.sqrt(known[0, 0] * known[1, 1])
        case "gap":
            known[0, 1] = np.nan
    changed = good.assign(covariance=(good["covariance"].dims, C.reshape(good["covariance"].shape)))
    assert datasets.violations(good) == []
    assert [each for each in datasets.violations(changed) if each.startswith("covariance: ")]
