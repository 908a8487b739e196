"""Damaged files of instruments: every mutant is read, or refused with an error of the project, in bounded time."""

import warnings
from pathlib import Path

import h5py
import mutants
import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.laser_tracker.tracker_table import TrackerTable, TrackerTableSettings
from errormotion.instruments.line_profiler.profile_files import ProfileFiles
from errormotion.instruments.line_profiler.profile_files.readers import check_complete, height_map
from errormotion.instruments.line_profiler.profile_files.settings import ProfileFileSettings
from errormotion.instruments.transports.recording import Recorder, read_index, read_recording, write_index

LENGTHS = """station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]
S1,1,1500.5,20.1,1013,40
S1,2,1501.25,20.2,1013,40
S2,1,900,20.3,1012,41
S2,2,901,20.4,1012,41
"""
HEIGHTS = "# um\n1.5,,3.25,\n-4,5e1,0.125,\n7,8,9,\n"
GRID = ProfileFileSettings(unit="um", x_pitch=1e-5, y_pitch=1e-5)
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
end_header
0 0 0.1
1 0 0.2
0 1 0.3
1 1 0.4
"""
PCD = """VERSION .7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 4
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 4
DATA ascii
0 0 0.1
1 0 0.2
0 1 0.3
1 1 0.4
"""


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_damaged_tables_of_lengths(tmp_path: Path) -> None:
    def read(data: bytes) -> None:
        (tmp_path / "lengths.csv").write_bytes(data)
        with TrackerTable(str(tmp_path / "lengths.csv"), TrackerTableSettings(repeats="last")) as table:
            table.read()

    assert mutants.check(read, LENGTHS.encode(), seed=1, number=mutants.count(400)) > 150


def test_damaged_height_maps(tmp_path: Path) -> None:
    def read(data: bytes) -> None:
        (tmp_path / "scan.csv").write_bytes(data)
        with ProfileFiles(str(tmp_path / "scan.csv"), GRID) as files:
            for scan in files.scans():
                assert scan.heights.shape == (scan.y.size, scan.x.size)

    assert mutants.check(read, HEIGHTS.encode(), seed=2, number=mutants.count(500)) > 100


def write_scan(path: Path, unit: object, height: object) -> None:
    xr.Dataset(
        {"height": (("profile", "point"), height, {"units": unit})},
        {"x": ("point", np.arange(4.0), {"units": "um"}), "y": ("profile", np.arange(3.0), {"units": "mm"})},
    ).to_netcdf(path, engine="h5netcdf")


def test_netcdf_height_maps_that_were_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "scan.nc"
    write_scan(path, "um", np.arange(12.0).reshape(3, 4))

    def read(data: bytes) -> None:
        path.write_bytes(data)
        with ProfileFiles(str(path)) as files:
            list(files.scans())

    # Cuts only: the HDF5 library reads changed bytes, and does not limit its time.
    refused = mutants.check(read, path.read_bytes(), seed=3, number=mutants.count(30), changes=(mutants.cut,))
    assert refused > 25


def test_netcdf_height_maps_with_other_content(tmp_path: Path) -> None:
    heights = np.arange(12.0).reshape(3, 4)
    good = b"um"
    write_scan(tmp_path / "scan.nc", "um", heights)

    def read(unit: bytes) -> None:
        with h5py.File(tmp_path / "scan.nc", "r+") as file:
            file["height"].attrs["units"] = unit.decode("utf-8", "replace").replace("\0", "")
        with ProfileFiles(str(tmp_path / "scan.nc")) as files:
            list(files.scans())

    assert mutants.check(read, good, seed=9, number=mutants.count(25)) > 8
    for content in (heights.astype(str), np.full((3, 4), np.inf), heights * 1e300, heights > 1, heights.astype("i1")):
        write_scan(tmp_path / "scan.nc", "um", content)
        with ProfileFiles(str(tmp_path / "scan.nc")) as files:
            try:
                (scan,) = files.scans()
            except InstrumentError:
                continue
            assert np.abs(scan.heights).max() < 1


BINARY = PLY.replace("ascii", "binary_little_endian").partition("0 0")[0] + 48 * "x"


@pytest.mark.parametrize("text", [PLY, PCD, BINARY], ids=["ply", "pcd", "binary"])
def test_damaged_heads_of_point_clouds(tmp_path: Path, text: str) -> None:
    def read(data: bytes) -> None:
        (tmp_path / "scan.ply").write_bytes(data)
        check_complete(tmp_path / "scan.ply")

    mutants.check(read, text.encode(), seed=4, number=mutants.count(400), limit=2.0)


def test_any_points_are_a_height_map_or_refused() -> None:
    rng = np.random.default_rng(5)
    values = (0.0, 1.0, 1.0 + 1e-12, -5.0, 1e300, np.nan, np.inf, -np.inf)
    for _ in range(mutants.count(500)):
        points = rng.choice(values, size=(rng.integers(0, 9), 3))
        try:
            heights, x, y = height_map(points, Path("scan.ply"))
        except InstrumentError:
            continue
        assert heights.shape == (y.size, x.size)


def test_damaged_recordings(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "good.rec", "tcp://127.0.0.1:5025")
    for k in range(5):
        recorder.frame("WR"[k % 2], bytes(range(k, k + 20)))
    recorder.close()

    def read(data: bytes) -> None:
        (tmp_path / "damaged.rec").write_bytes(data)
        read_recording(tmp_path / "damaged.rec")

    refused = mutants.check(read, (tmp_path / "good.rec").read_bytes(), seed=6, number=mutants.count(400))
    assert refused > 360


def test_damaged_lists_of_recordings_and_scans(tmp_path: Path) -> None:
    write_index(tmp_path / "list.rec", ["spindle", "frame"])

    def read(data: bytes) -> None:
        (tmp_path / "damaged.rec").write_bytes(data)
        read_index(tmp_path / "damaged.rec")

    mutants.check(read, (tmp_path / "list.rec").read_bytes(), seed=7, number=mutants.count(200))
    (tmp_path / "scan.csv").write_text(HEIGHTS)
    with ProfileFiles(str(tmp_path / "scan.csv"), GRID, record=tmp_path / "scans.rec") as files:
        files.identify()

    def replay(data: bytes) -> None:
        (tmp_path / "damaged.rec").write_bytes(data)
        with ProfileFiles(f"replay://{tmp_path / 'damaged.rec'}", GRID) as files:
            files.identify()

    good = (tmp_path / "scans.rec").read_bytes()
    mutants.check(replay, good, seed=8, number=mutants.count(200))
    with raises("scans.file.name"):
        replay(good.replace(b"scan.csv", b"scan.csv\0"))
