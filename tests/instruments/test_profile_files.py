"""Scans in files: values from each kind of file, and refusals with their messages."""

import subprocess
import sys
from pathlib import Path

import needed_open3d
import numpy as np
import pytest
import xarray as xr
from coded import raises
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from errormotion.datasets.units import EDGE
from errormotion.errors import InstrumentError
from errormotion.instruments.line_profiler.profile_files import ProfileFiles, ProfileFileSettings
from errormotion.instruments.line_profiler.profile_files.readers import height_map
from errormotion.plugins.readings import Scan

X = -0.5e-3 + 12.5e-6 * np.arange(40)
Y = 70e-6 * np.arange(25)
HEIGHTS = 1e-3 * np.sin(np.add.outer(900 * Y, 4000 * X))
HEIGHTS[3, 5] = HEIGHTS[20, 30:33] = np.nan
MM = ProfileFileSettings(unit="mm")
GRID = ProfileFileSettings(unit="um", x_pitch=12.5e-6, y_pitch=70e-6)


def points() -> np.ndarray:
    """The scan as points (n, 3), m, without missing heights, in any order."""
    grid = np.stack([np.broadcast_to(X, HEIGHTS.shape), np.broadcast_to(Y[:, None], HEIGHTS.shape), HEIGHTS], axis=-1)
    flat = grid.reshape(-1, 3)
    return np.random.default_rng(1).permutation(flat[np.isfinite(flat[:, 2])])


def write_cloud(path: Path, positions: np.ndarray, ascii: bool = False) -> Path:
    if path.suffix == ".xyz":
        np.savetxt(path, positions, fmt="%.10g")
        return path
    open3d = needed_open3d.open3d()
    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(positions))
    assert open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=ascii)
    return path


def write_netcdf(path: Path, unit: str = "mm", y: np.ndarray = Y) -> Path:
    factor = {"m": 1.0, "mm": 1e3}[unit]
    xr.Dataset(
        {"height": (("profile", "point"), HEIGHTS * factor, {"units": unit})},
        {"x": ("point", X * 1e6, {"units": "um"}), "y": ("profile", y, {"units": "m"})},
    ).to_netcdf(path, engine="h5netcdf")
    return path


def write_csv(path: Path, rows: np.ndarray = HEIGHTS) -> Path:
    lines = [",".join("" if np.isnan(z) else f"{z * 1e6:.6f}" for z in row) for row in rows]
    path.write_text("# heights in um\n" + "\n".join(lines) + "\n")
    return path


def scan(path: Path, chosen: ProfileFileSettings | None = None) -> Scan:
    with ProfileFiles(str(path), chosen) as files:
        (found,) = files.scans()
        return found


@pytest.mark.parametrize(("suffix", "dtype"), [(".ply", "f8"), (".ply", "f4"), (".pcd", "f4"), (".xyz", "f8")])
def test_a_point_cloud_becomes_a_height_map_to_the_rounding_of_its_file(
    tmp_path: Path, suffix: str, dtype: str
) -> None:
    found = scan(write_cloud(tmp_path / f"scan{suffix}", (1e3 * points()).astype(dtype)), MM)
    rounding = 1e-9 if suffix == ".xyz" or dtype == "f4" else 1e-12  # 2 mm in 24 bits: 0.1 nm; xyz: ten digits
    assert found.heights == pytest.approx(HEIGHTS, abs=rounding, nan_ok=True)
    assert found.x == pytest.approx(X, abs=rounding)
    assert found.y == pytest.approx(Y, abs=rounding)


LINES = [f"{x:.3f} {y:.3f} {0.1 + x / 50 + y / 9:.5f}" for y in (0.0, 0.1, 0.2) for x in (0.0, 0.05, 0.1, 0.15)]


@pytest.mark.parametrize(
    "data",
    [
        "\n".join(LINES).encode(),
        "\r\n".join(LINES).encode() + b"\r\n",
        b"\xef\xbb\xbf" + "\n".join(LINES).encode(),
        "\n".join(LINES).encode("utf-16"),
        "\n\n".join(["# made by X", "// points", *LINES, ""]).replace(" ", "\t").encode(),
    ],
    ids=["no last line end", "CR LF", "byte order mark", "UTF-16", "comments, blank lines and tabs"],
)
def test_all_points_of_a_text_are_read(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "scan.xyz").write_bytes(data)
    found = scan(tmp_path / "scan.xyz", MM)
    expected = np.array([float(line.split()[2]) for line in LINES]).reshape(3, 4) * 1e-3
    np.testing.assert_allclose(found.heights, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("place", "line", "message"),
    [
        (1, "0 0 0,10000", r"line 1: expected three numbers separated by spaces; found '0 0 0,10000'; a decimal comma"),
        (1, "X Y Z", r"line 1: expected three numbers .* found 'X Y Z'"),
        (3, "0.05,0.1,0.12", r"line 3: .* found '0.05,0.1,0.12'"),
        (5, "0.05 0.1 0.12mm", r"line 5: .* found '0.05 0.1 0.12mm'"),
        (6, "0.05 0.1", r"line 6: .* found '0.05 0.1'"),
        (2, "0.05 0.1 0.12 7", r"line 2: .* found '0.05 0.1 0.12 7'"),
        (2, "0.05 0.1 1_2", r"line 2: .* found '0.05 0.1 1_2'"),
    ],
)
def test_a_line_that_is_no_point_is_named(tmp_path: Path, place: int, line: str, message: str) -> None:
    lines = [*LINES[: place - 1], line, *LINES[place - 1 :]]
    (tmp_path / "scan.xyz").write_text("\n".join(lines))
    with pytest.raises(InstrumentError, match=message):
        scan(tmp_path / "scan.xyz", MM)


def test_a_text_in_another_encoding_or_without_points_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scan.xyz").write_bytes("# Höhe\n0 0 0".encode("cp1252"))
    with raises("scans.encoding"):
        scan(tmp_path / "scan.xyz", MM)
    (tmp_path / "scan.xyz").write_text("# nothing\n\n")
    with raises("scans.no_points"):
        scan(tmp_path / "scan.xyz", MM)


def test_a_csv_height_map_takes_its_pitches_from_the_settings(tmp_path: Path) -> None:
    found = scan(write_csv(tmp_path / "scan.csv"), GRID)
    assert found.heights == pytest.approx(HEIGHTS, abs=1e-12, nan_ok=True)
    assert found.x == pytest.approx(12.5e-6 * np.arange(40))
    assert found.y == pytest.approx(Y)


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_a_netcdf_file_names_its_own_units(tmp_path: Path, unit: str) -> None:
    found = scan(write_netcdf(tmp_path / "scan.nc", unit))
    assert found.heights == pytest.approx(HEIGHTS, rel=1e-12, nan_ok=True)
    assert found.x == pytest.approx(X, rel=1e-12, abs=1e-18)


def test_a_number_may_mean_a_missing_height(tmp_path: Path) -> None:
    (tmp_path / "scan.csv").write_text("1;-9999;3\n4;5;-9999\n")
    chosen = GRID.model_copy(update={"no_value": -9999.0, "delimiter": ";"})
    found = scan(tmp_path / "scan.csv", chosen)
    assert found.heights == pytest.approx(1e-6 * np.array([[1, np.nan, 3], [4, 5, np.nan]]), nan_ok=True)


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_a_number_for_a_missing_height_is_found_in_files_of_32_bits(tmp_path: Path, kind: str) -> None:
    heights = np.where(np.isnan(HEIGHTS), -99.9999, 1e3 * HEIGHTS)
    xr.Dataset(
        {"height": (("profile", "point"), heights.astype(kind), {"units": "mm"})},
        {"x": ("point", X, {"units": "m"}), "y": ("profile", Y, {"units": "m"})},
    ).to_netcdf(tmp_path / "scan.nc")
    found = scan(tmp_path / "scan.nc", MM.model_copy(update={"no_value": -99.9999}))
    np.testing.assert_array_equal(np.isnan(found.heights), np.isnan(HEIGHTS))


@pytest.mark.parametrize(
    ("numbers", "refused"),
    [
        ("1,-9999,3\n4,5,2\n", True),  # nines
        ("1,-500,3\n4,5,-500\n", True),  # twice
        ("1,999.9999,3\n4,5,2\n", True),
        ("1,-500,3\n4,5,2\n", False),  # an outlier
        ("1,-9.9,3\n4,5,2\n", False),
        ("1,1,1\n1,1,2\n", False),
    ],
)
def test_a_number_that_may_stand_for_no_value_is_refused_until_it_is_stated(
    tmp_path: Path, numbers: str, refused: bool
) -> None:
    (tmp_path / "scan.csv").write_text(numbers)
    if refused:
        with raises("scans.no_value"):
            scan(tmp_path / "scan.csv", GRID)
    else:
        assert np.isfinite(scan(tmp_path / "scan.csv", GRID).heights).all()


@pytest.mark.parametrize(
    "text", ["1,,3,\n4,5,,\n", "1,,3\n4,5,,\n", "# um\r\n1, ,3 ,\r\n\r\n4,5, , \r\n", "1,,3,,\n4,5,,,\n"]
)
def test_a_delimiter_at_the_end_of_the_lines_adds_no_column(tmp_path: Path, text: str) -> None:
    (tmp_path / "scan.csv").write_text(text)
    found = scan(tmp_path / "scan.csv", GRID)
    expected = [[1, np.nan, 3], [4, 5, np.nan]]
    if text.endswith(",,,\n"):  # one delimiter ends the line, the others separate cells
        expected = [[*row, np.nan] for row in expected]
    assert found.heights == pytest.approx(1e-6 * np.array(expected), nan_ok=True)
    assert found.x.size == len(expected[0])


def test_several_files_stream_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write_netcdf(tmp_path / f"{name}.nc")
    with ProfileFiles(f"file://{tmp_path}/*.nc") as files:
        assert [found.path.name for found in files.scans()] == ["a.nc", "b.nc"]
        blocks = list(files.stream(block=10))
        assert len(files.identify().details["files"]) == 2
        assert files.read() == pytest.approx(HEIGHTS[0], rel=1e-12)
    assert [block.first for block in blocks] == [0, 10, 20, 25, 35, 45]
    assert np.concatenate([block.y for block in blocks]) == pytest.approx(np.tile(Y, 2))
    assert np.concatenate([block.heights for block in blocks])[:25] == pytest.approx(HEIGHTS, rel=1e-12, nan_ok=True)
    assert sum(block.invalid.get("no value", 0) for block in blocks) == 2 * 4
    assert np.isnan(blocks[0].encoder).all()


@settings(max_examples=30)
@given(
    shape=st.tuples(st.integers(2, 30), st.integers(2, 30)),
    ratio=st.floats(0.2, 5.0),
    seed=st.integers(0, 1000),
)
def test_any_grid_with_a_few_holes_is_found_again(shape: tuple[int, int], ratio: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=shape)
    truth.ravel()[rng.permutation(truth.size)[: truth.size // 10]] = np.nan
    truth[0, :], truth[:, 0] = 1.0, 1.0  # every line has a point
    x, y = np.arange(shape[1], dtype=float), ratio * np.arange(shape[0])
    grid = np.stack([*np.meshgrid(x, y), truth], axis=-1).reshape(-1, 3)
    heights, columns, rows = height_map(rng.permutation(grid[np.isfinite(grid[:, 2])]), Path("x"))
    assert heights.tobytes() == truth.tobytes()
    assert columns == pytest.approx(x)
    assert rows == pytest.approx(y)


@pytest.mark.slow
def test_parallel_kernels_start_without_a_warning_after_a_cloud_was_read(tmp_path: Path) -> None:
    path = write_cloud(tmp_path / "scan.ply", (1e3 * points()).astype("f4"))
    program = f"""
import warnings
from errormotion.instruments.line_profiler.profile_files import ProfileFiles, ProfileFileSettings
with ProfileFiles({str(path)!r}, ProfileFileSettings(unit="mm")) as files:
    files.read()
import numba
@numba.njit(parallel=True)
def total(n):
    s = 0
    for i in numba.prange(n):
        s += i
    return s
warnings.simplefilter("error")
assert total(10) == 45
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ------------------------------------------------------------------ refusals


def test_without_a_unit_a_file_that_names_none_is_refused(tmp_path: Path) -> None:
    for path in (write_csv(tmp_path / "scan.csv"), write_cloud(tmp_path / "scan.ply", points())):
        with raises("scans.unit.missing"):
            scan(path)


def test_millimetres_taken_for_metres_are_detected(tmp_path: Path) -> None:
    path = write_cloud(tmp_path / "scan.ply", 1e3 * points())
    with raises("scans.unit.implausible"):
        scan(path, ProfileFileSettings(unit="m"))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("1,2,3\n4,5\n", "scans.line.cells"),
        ("1,2,3\n4,five,6\n", "scans.line.form"),
        ("1,2,3\n4,5,6,7,\n", "scans.line.cells"),
        ("# nothing\n", "scans.no_heights"),
        (",,\n,,\n", "scans.no_heights"),
    ],
)
def test_a_file_that_is_not_csv_is_refused_with_its_line(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "scan.csv").write_text(text)
    with raises(code):
        scan(tmp_path / "scan.csv", GRID)


def test_heights_without_pitches_are_refused(tmp_path: Path) -> None:
    with raises("scans.pitch.missing"):
        scan(write_csv(tmp_path / "scan.csv"), ProfileFileSettings(unit="um"))


def test_a_feed_that_turns_is_refused(tmp_path: Path) -> None:
    there_and_back = np.concatenate([Y[:13], Y[11::-1]])
    with raises("scans.order"):
        scan(write_netcdf(tmp_path / "scan.nc", y=there_and_back))


@pytest.mark.parametrize("part", [0.02, 0.5, 0.999])
@pytest.mark.parametrize(
    ("suffix", "ascii"), [(".ply", False), (".ply", True), (".pcd", False), (".pcd", True), (".nc", False)]
)
def test_a_file_that_is_cut_off_is_refused(tmp_path: Path, suffix: str, ascii: bool, part: float) -> None:
    path = tmp_path / f"scan{suffix}"
    if suffix == ".nc":
        write_netcdf(path)
    else:
        write_cloud(path, (1e3 * points()).astype("f4"), ascii)
        assert np.isfinite(scan(path, MM).heights).sum() == len(points())
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * part)])
    with pytest.raises(InstrumentError, match="cannot be read"):
        scan(path, MM)


def test_a_netcdf_file_without_units_or_variables_is_refused(tmp_path: Path) -> None:
    xr.Dataset({"z": ("profile", np.zeros(3))}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with raises("scans.variable.missing"):
        scan(tmp_path / "a.nc")
    xr.Dataset({"height": (("profile", "point"), HEIGHTS)}).to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    with raises("scans.unit.missing"):
        scan(tmp_path / "b.nc")


def test_a_point_cloud_that_is_not_a_height_map_is_refused(tmp_path: Path) -> None:
    anywhere = np.random.default_rng(2).uniform(0, 1e-2, (500, 3))
    with raises("scans.no_height_map"):
        height_map(anywhere, tmp_path)
    with raises("scans.no_height_map"):
        height_map(np.concatenate([points(), points()[:1]]), tmp_path)


@pytest.mark.parametrize(
    ("address", "code"),
    [("none.ply", "scans.not_found"), ("tcp://127.0.0.1:9", "scans.address.form"), ("*.nc", "scans.not_found")],
)
def test_an_address_without_files_is_refused(address: str, code: str) -> None:
    with raises(code):
        ProfileFiles(address).open()


def test_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scan.stl").write_text("solid")
    with raises("scans.file.ending"):
        scan(tmp_path / "scan.stl", MM)


def test_settings_name_their_units() -> None:
    read = ProfileFileSettings.model_validate({"unit": "um", "x_pitch": "12.5 um", "y_pitch": "0.07 mm"}, context=EDGE)
    assert (read.x_pitch, read.y_pitch) == pytest.approx((12.5e-6, 70e-6))
    for wrong in ({"unit": "furlong"}, {"x_pitch": 12.5}, {"y_pitch": "-1 mm"}):
        with pytest.raises(ValidationError):
            ProfileFileSettings.model_validate(wrong, context=EDGE)


# ------------------------------------------------------------------ recordings


def test_a_recording_refers_to_the_unchanged_files(tmp_path: Path) -> None:
    path, recording = write_netcdf(tmp_path / "scan.nc"), tmp_path / "session.rec"
    with ProfileFiles(str(path), record=recording) as files:
        heights = files.read()
    with ProfileFiles(f"replay://{recording}") as files:
        assert (files.read() == heights).all()
    write_netcdf(path, "m")
    with raises("recording.file.changed"):
        ProfileFiles(f"replay://{recording}").open()
    with raises("recording.not_created"):
        ProfileFiles(str(path), record=recording).open()
    (tmp_path / "other.rec").write_text("something\n")
    with raises("recording.form"):
        ProfileFiles(f"replay://{tmp_path / 'other.rec'}").open()
