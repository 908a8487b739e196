"""Small files that state or contain gigabytes are refused before a library reads them; ordinary ones are read."""

import json
import os
import struct
import time
import tracemalloc
import zlib
from pathlib import Path
from zipfile import ZipFile

import h5py
import numpy as np
import pytest
import xarray as xr
from coded import raises
from numcodecs import Blosc, Zstd
from openpyxl import Workbook
from scipy.io import savemat

from errormotion.datasets.files.containers import check_netcdf
from errormotion.datasets.files.hdf5 import Stored
from errormotion.datasets.storage.disk import load, save
from errormotion.datasets.tables import binary, sheets
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.reading import read_table
from errormotion.errors import DatasetError

TEXTS, LENGTH = 20_000, 100_000  # 2 GB of texts in 0.4 MB
MAX_MEMORY = 64 << 20


def refuse(path: Path, match: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=match):
            load(path)
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()


def references(raw: bytes) -> list[int]:
    """Return the places of all references to the heaps: length, address, index."""
    heaps, at = set(), raw.find(b"GCOL")
    while at >= 0:
        heaps.add(at)
        at = raw.find(b"GCOL", at + 4)
    found = []
    for heap in heaps:
        at = raw.find(struct.pack("<Q", heap))
        while at >= 4:
            found.append(at - 4)
            at = raw.find(struct.pack("<Q", heap), at + 1)
    return found


def shared(path: Path, **options: object) -> None:
    """Write texts, then make all references name the longest text."""
    texts = np.array(["a", *(f"{k}" for k in range(TEXTS - 1))], object)
    with h5py.File(path, "w") as file:
        file.create_dataset("long", data="x" * LENGTH, dtype=h5py.string_dtype())
        if options.pop("attribute", False):
            file.create_dataset("n", data=1.0).attrs.create("many", texts[:4000], dtype=h5py.string_dtype())
        else:
            variable = file.create_dataset("t", (TEXTS,), h5py.string_dtype(), **options)
            variable[:] = texts
    raw = bytearray(path.read_bytes())
    places = references(bytes(raw))
    [longest] = [raw[at : at + 16] for at in places if raw[at : at + 4] == struct.pack("<I", LENGTH)]
    for at in places:
        raw[at : at + 16] = longest
    path.write_bytes(raw)


@pytest.mark.parametrize(
    "options", [{}, {"chunks": (5000,)}, {"attribute": True}, {"chunks": (500,), "compression": 1}]
)
def test_texts_that_share_one_object_of_the_heap_are_refused(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "texts.nc"
    if "compression" in options:  # references in compressed chunks cannot be altered in place: the limit is a bound
        with h5py.File(path, "w") as file:
            file.create_dataset("long", data="x" * LENGTH, dtype=h5py.string_dtype())
            file.create_dataset("t", (TEXTS,), h5py.string_dtype(), **options)[:] = "a"
    else:
        shared(path, **options)
    refuse(path, r"expected at most \d+ bytes of values .* it states")


def test_many_texts_and_long_texts_are_read(tmp_path: Path) -> None:
    names = np.array([f"sensor {k}" for k in range(50_000)])
    ds = xr.Dataset({"value": ("name", np.zeros(names.size))}, {"name": names})
    ds.attrs = {f"text {k}": "x" * 20_000 for k in range(300)}
    path = save(ds, tmp_path / "texts.nc")
    with load(path) as found:
        assert found["name"].values.tolist() == names.tolist()
        assert found.attrs == ds.attrs


@pytest.mark.parametrize("filters", [{}, {"shuffle": True}, {"fletcher32": True}])
def test_chunks_that_contain_more_than_they_state_are_refused(tmp_path: Path, filters: dict[str, bool]) -> None:
    path = tmp_path / "deflated.nc"
    with h5py.File(path, "w") as file:
        variable = file.create_dataset("v", (4000,), "f8", chunks=(1000,), compression=1, **filters)
        variable[:] = np.arange(4000)
        variable.id.write_direct_chunk((2000,), zlib.compress(bytes(200_000_000), 9))
    refuse(path, r"'v': expected chunks of at most 80\d\d bytes; found one that contains more")


def test_other_filters_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "lzf.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=np.zeros(4000), chunks=(1000,), compression="lzf")
    refuse(path, "compressed by deflate")


@pytest.mark.parametrize("checked", [False, True])
def test_compressed_values_are_read(tmp_path: Path, checked: bool) -> None:
    path, values = tmp_path / "values.nc", np.random.default_rng(0).normal(size=(300, 100))
    with h5py.File(path, "w") as file:
        file["y"], file["x"] = np.arange(300.0), np.arange(100.0)
        file["y"].make_scale("y")
        file["x"].make_scale("x")
        options = {"chunks": (7, 100), "compression": 1, "shuffle": True, "fletcher32": checked}
        variable = file.create_dataset("v", data=values, **options)
        for axis, name in enumerate("yx"):
            variable.dims[axis].attach_scale(file[name])
        variable.id.write_direct_chunk((7, 0), values[7:14].tobytes(), filter_mask=0b111 if checked else 0b11)
    with load(path) as found:
        np.testing.assert_array_equal(found["v"].values, values)


def zarr(path: Path, codecs: list[str], pack) -> Path:
    """Write a Zarr folder of one array with codecs, and alter its first chunk."""
    save(xr.Dataset({"v": ("x", np.zeros(1000))}), path)
    file = path / "v" / "zarr.json"
    metadata = json.loads(file.read_text())
    known = {each["name"]: each for each in metadata["codecs"]}
    known["blosc"] = {"name": "blosc", "configuration": {"cname": "zstd", "clevel": 5, "shuffle": "noshuffle",
                                                         "typesize": 8, "blocksize": 0}}  # fmt: skip
    metadata["codecs"] = [known.get(name, {"name": name, "configuration": {}}) for name in codecs]
    file.write_text(json.dumps(metadata))
    chunk = path / "v" / "c" / "0"
    chunk.parent.mkdir(exist_ok=True)
    chunk.write_bytes(pack(bytes(8000)))
    return path


def test_further_frames_of_a_chunk_are_refused(tmp_path: Path) -> None:
    bomb = Zstd(level=19).encode(bytes(500_000_000))
    for codecs, end in ((["bytes", "zstd"], b""), (["bytes", "zstd", "crc32c"], b"1234")):
        path = zarr(
            tmp_path / f"{len(codecs)}.zarr", codecs, lambda values, end=end: Zstd().encode(values) + bomb + end
        )
        refuse(path, "expected a chunk of one Zstandard frame; found more behind it")
    skippable = b"\x50\x2a\x4d\x18" + struct.pack("<I", 4) + b"skip"
    refuse(
        zarr(tmp_path / "skip.zarr", ["bytes", "zstd"], lambda values: Zstd().encode(values) + skippable),
        "expected a chunk of one Zstandard frame",
    )


@pytest.mark.parametrize("codecs", [["bytes", "blosc", "zstd"], ["bytes", "zstd", "blosc"]])
def test_a_compressor_within_another_is_refused(tmp_path: Path, codecs: list[str]) -> None:
    inner, outer = (Blosc(), Zstd()) if codecs[1] == "blosc" else (Zstd(), Blosc())
    path = zarr(tmp_path / "twice.zarr", codecs, lambda values: bytes(outer.encode(inner.encode(values))))
    refuse(path, "one of blosc and zstd at most")


@pytest.mark.parametrize("codecs", [["bytes", "zstd"], ["bytes", "blosc"], ["bytes", "zstd", "crc32c"]])
def test_one_frame_is_read(tmp_path: Path, codecs: list[str]) -> None:
    values = np.random.default_rng(0).normal(size=60_000)
    path = tmp_path / "values.zarr"
    options = {"cname": "zstd", "clevel": 5, "shuffle": "shuffle", "typesize": 8, "blocksize": 0}
    xr.Dataset({"v": ("x", values)}).chunk().to_zarr(
        path,
        zarr_format=3,
        consolidated=False,
        encoding={"v": {"compressors": [_codec(name, options) for name in codecs[1:]]}},
    )
    with load(path) as found:
        np.testing.assert_array_equal(found["v"].values, values)


def _codec(name: str, options: dict[str, object]) -> object:
    from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

    return {"zstd": ZstdCodec, "crc32c": Crc32cCodec}[name]() if name != "blosc" else BloscCodec(**options)


def dimension(file: h5py.File, size: int) -> None:
    scale = file.create_dataset("p", (size,), ">f4")
    scale.attrs.create("_Netcdf4Dimid", 0, dtype=np.int32)
    h5py.h5ds.set_scale(scale.id, b"This is a netCDF dimension but not a netCDF variable")


def along(variable: h5py.Dataset) -> None:
    variable.attrs.create("_Netcdf4Coordinates", [0], dtype=np.int32)
    h5py.h5ds.attach_scale(variable.id, variable.file["p"].id, 0)


def test_chunks_without_values_are_counted(tmp_path: Path) -> None:
    netcdf, zarr = tmp_path / "chunks.nc", tmp_path / "chunks.zarr"
    with h5py.File(netcdf, "w") as file:
        dimension(file, 200_000)
        along(file.create_dataset("v", (200_000,), "i1", chunks=(1,)))
    refuse(netcdf, r"expected at most \d+ bytes of values .* it states")
    save(xr.Dataset({"v": ("p", np.zeros(4, np.int8))}), zarr)
    place = zarr / "v" / "zarr.json"
    stated = json.loads(place.read_text())
    stated["shape"], stated["chunk_grid"]["configuration"]["chunk_shape"] = [200_000], [1]
    place.write_text(json.dumps(stated))
    refuse(zarr, r"expected at most \d+ bytes of values .* it states")


def test_the_time_for_chunks_and_attributes_is_in_proportion_to_their_number(tmp_path: Path) -> None:
    def seconds(count: int) -> float:
        path = tmp_path / f"{count}.nc"
        with h5py.File(path, "w", libver="latest") as file:
            dimension(file, count)
            along(file.create_dataset("v", data=np.zeros(count, np.int8), chunks=(1,), compression=1))
            for k in range(count):
                file.attrs[f"a{k}"] = k
        start = time.process_time()
        check_netcdf(path)
        return time.process_time() - start

    seconds(10)
    assert seconds(8000) < 30 * seconds(1000)  # 8 times; 64 times where each takes as long as there are others


def test_texts_with_the_width_of_one_long_text_are_refused(tmp_path: Path) -> None:
    netcdf, zarr = tmp_path / "wide.nc", tmp_path / "wide.zarr"
    texts = ["x" * LENGTH, *[""] * 3000]  # 1.2 GB in an array of numpy
    with h5py.File(netcdf, "w") as file:
        dimension(file, len(texts))
        along(file.create_dataset("t", data=np.array(texts, object), dtype=h5py.string_dtype()))
    refuse(netcdf, r"expected at most \d+ bytes of values .* it states")
    save(xr.Dataset({"t": ("p", np.array(["a"] * len(texts)))}), zarr)
    content = b"".join(struct.pack("<I", len(each)) + each.encode() for each in texts)
    (zarr / "t" / "c" / "0").write_bytes(Zstd().encode(struct.pack("<I", len(texts)) + content))
    refuse(zarr, "its texts need")


def test_values_that_become_larger_when_they_are_scaled_are_counted_so(tmp_path: Path) -> None:
    path = tmp_path / "scaled.nc"
    with h5py.File(path, "w") as file:
        dimension(file, 200)
        file.create_dataset("v", (150 << 20,), "i1", chunks=(1 << 20,)).attrs["scale_factor"] = 0.5
        file.create_dataset("r", data=np.random.default_rng(1).random(1 << 17))
    refuse(path, r"expected at most \d+ bytes of values .* it states")


@pytest.mark.parametrize("place", ["variable", "attribute"])
def test_compounds_of_texts_are_refused(tmp_path: Path, place: str) -> None:
    path = tmp_path / "compound.nc"
    kind = np.dtype([(f"f{k}", h5py.string_dtype()) for k in range(50)])
    with h5py.File(path, "w") as file:
        if place == "variable":
            file.create_dataset("c", (10,), kind)
        else:
            file.attrs.create("a", np.array([("a",) * 50] * 10, kind), dtype=kind)
    refuse(path, "expected numbers or texts")


def test_forged_heaps_are_not_followed_to_their_end(tmp_path: Path) -> None:
    """Each of many heaps leads to the same long chain of objects."""
    path = tmp_path / "heap.nc"
    with h5py.File(path, "w") as file:
        file.create_dataset("t", (5000,), h5py.string_dtype(), chunks=(5000,), compression=1)[:] = "ab"
    heaps, objects = 4000, 60_000
    forged = bytearray(b"\0" * (-path.stat().st_size % 16))
    for k in range(heaps):
        rest = 32 * (heaps - k)
        forged += b"GCOL\1\0\0\0" + struct.pack("<Q", rest + 16 * objects)
        forged += struct.pack("<HHIQ", 1, 1, 0, rest - 32)
    forged += struct.pack("<HHIQ", 1, 1, 0, 0) * objects
    with path.open("ab") as raw:
        raw.write(forged)
    size = path.stat().st_size
    with h5py.File(path) as file:  # not all 240 million objects are followed; nothing is larger than the file
        assert Stored(path, size, file)._largest() == size
    refuse(path, r"expected at most \d+ bytes of values .* it states")


def test_netcdf_3_variables_that_share_their_bytes_are_refused(tmp_path: Path) -> None:
    path, count, size = tmp_path / "classic.nc", 500, 1 << 20
    head = b"CDF\2" + struct.pack(">4i", 0, 10, 1, 1) + b"n\0\0\0" + struct.pack(">3i", size, 0, 0)

    def variables(begin: int) -> bytes:
        found = struct.pack(">2i", 11, count)
        for k in range(count):
            found += struct.pack(">i", 8) + b"v%07d" % k + struct.pack(">6iq", 1, 0, 0, 0, 1, size, begin)
        return found

    path.write_bytes(head + variables(len(head) + len(variables(0))) + bytes(size))
    refuse(path, r"expected at most \d+ bytes of values .* it states")


@pytest.mark.parametrize("rate", [5e-324, np.inf])
def test_a_rate_without_finite_times_is_refused(tmp_path: Path, rate: float) -> None:
    path = tmp_path / "rate.nc"
    xr.Dataset({"v": ("time", np.zeros(4))}, attrs={"sample_rate": rate}).to_netcdf(path, engine="h5netcdf")
    refuse(path, "rate.nc: sample_rate, time_start: expected finite times")


def test_an_empty_dimension_does_not_hide_the_size_of_another(tmp_path: Path) -> None:
    path = tmp_path / "empty.zarr"
    save(xr.Dataset({"v": (("time", "s"), np.zeros((4, 1)))}), path)
    place = path / "v" / "zarr.json"
    stated = json.loads(place.read_text())
    stated["shape"] = [1 << 40, 0]
    place.write_text(json.dumps(stated))
    refuse(path, r"expected at most \d+ bytes of values .* it states")


def test_a_netcdf_file_with_64_bit_counts_is_refused_and_not_read_as_another_format(tmp_path: Path) -> None:
    path = tmp_path / "cdf5.nc"
    path.write_bytes(b"CDF\5" + bytes(64))
    refuse(path, "is not a dataset")


def refuse_table(path: Path, code: str, sheet: str = "") -> None:
    """Assert that a table is refused with a code, before much memory is needed."""
    tracemalloc.start()
    try:
        with raises(code):
            read_table(path, Format(sheet=sheet))
        assert tracemalloc.get_traced_memory()[1] < MAX_MEMORY
    finally:
        tracemalloc.stop()


def foreign(path: Path) -> Path:
    """Write a file of numbers that is not to be read."""
    (path / "secret.bin").write_bytes(np.arange(20.0).tobytes())
    with h5py.File(path / "secret.h5", "w") as file:
        file["group/time"] = file["group/temperature"] = np.arange(20.0)
    return path / "secret.bin"


@pytest.mark.parametrize("kind", ["external", "virtual"])
def test_a_table_of_hdf5_has_its_values_in_its_file(tmp_path: Path, kind: str) -> None:
    secret, path = foreign(tmp_path), tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(20.0)
        if kind == "external":
            file.create_dataset("t", (20,), "f8", external=[(str(secret), 0, 160)])
        else:
            layout = h5py.VirtualLayout((20,), "f8")
            layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "group/time", (20,))
            file.create_virtual_dataset("t", layout)
    refuse_table(path, "file.malicious")


@pytest.mark.parametrize("sheet", ["g", "soft", "inner/g", "inner//g", "time", "/", "pipe"])
def test_a_group_of_hdf5_is_not_a_link(tmp_path: Path, sheet: str) -> None:
    foreign(tmp_path)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["inner/time"] = np.arange(20.0)
        file["time"] = file["inner/time"]
        file["g"] = file["inner/g"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/group")
        file["soft"] = h5py.SoftLink("/inner")
        file["pipe"] = h5py.ExternalLink(str(tmp_path / "pipe"), "/group")  # reading it would wait for ever
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
    refuse_table(tmp_path / "a.h5", "file.sheet.unknown", sheet)
    assert read_table(tmp_path / "a.h5", Format(sheet="inner")).titles == ["time"]
    assert read_table(tmp_path / "a.h5").titles == ["inner/time"]  # "time" is the same dataset


def test_a_small_table_of_hdf5_does_not_state_gigabytes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "fill.h5", "w") as file:
        for k in range(20):
            file.create_dataset(f"d{k}", (1 << 28,), "f8")
    refuse_table(tmp_path / "fill.h5", "file.malicious")
    with h5py.File(tmp_path / "wide.h5", "w") as file:
        file.create_dataset("a", (1 << 16,), "S65535")
    refuse_table(tmp_path / "wide.h5", "file.malicious")
    with h5py.File(tmp_path / "deep.h5", "w") as file:
        group = file
        for _ in range(40):
            group = group.create_group("g")
        group["a"] = np.arange(20.0)
    refuse_table(tmp_path / "deep.h5", "file.malicious")
    with h5py.File(tmp_path / "unit.h5", "w") as file:
        file["a"] = np.arange(20.0)
        file["a"].attrs.create("units", np.array(["mm"] * 3000, object), dtype=h5py.string_dtype())
        file["self"] = file["/"]
    assert read_table(tmp_path / "unit.h5").units == [""]


def test_a_small_file_of_matlab_or_netcdf3_does_not_unpack_to_gigabytes(tmp_path: Path) -> None:
    """A cell states one value, whatever it contains; a compressed element any number; variables the same bytes."""
    path = tmp_path / "a.mat"
    savemat(path, {"time": np.arange(20.0), "cell": np.array([np.arange(3.0), "a"], object)}, do_compression=True)
    assert read_table(path).titles == ["time"]
    packer = zlib.compressobj(9)
    piece = bytes(1 << 20)
    packed = b"".join(packer.compress(piece) for _ in range((binary.MAX_UNPACKED >> 20) + 2)) + packer.flush()
    path.write_bytes(path.read_bytes() + struct.pack("<II", 15, len(packed)) + packed)
    refuse_table(path, "file.too_large")


def sheet(path: Path, cells: str) -> None:
    """Write a spreadsheet with the cells of one sheet, as XML."""
    begin, home = '<?xml version="1.0" encoding="UTF-8"?>', "http://schemas.openxmlformats.org"
    main, of_office = f"{home}/spreadsheetml/2006/main", f"{home}/officeDocument/2006/relationships"
    links = f'{begin}<Relationships xmlns="{home}/package/2006/relationships"><Relationship Id="a" '
    with ZipFile(path, "w") as file:
        file.writestr(
            "_rels/.rels", f'{links}Type="{of_office}/officeDocument" Target="xl/workbook.xml"/></Relationships>'
        )
        file.writestr(
            "xl/workbook.xml",
            f'{begin}<workbook xmlns="{main}" xmlns:r="{of_office}"><sheets><sheet name="s" sheetId="1" r:id="a"/>'
            "</sheets></workbook>",
        )
        file.writestr(
            "xl/_rels/workbook.xml.rels",
            f'{links}Type="{of_office}/worksheet" Target="worksheets/sheet1.xml"/></Relationships>',
        )
        file.writestr(
            "xl/worksheets/sheet1.xml",
            f'{begin}<worksheet xmlns="{main}"><sheetData>{cells}</sheetData></worksheet>',
        )


TABLE = "".join(f'<row r="{k}"><c r="A{k}"><v>{k}</v></c><c r="B{k}"><v>{2 * k}</v></c></row>' for k in range(1, 9))
LAST = '<row r="1048576"><c r="XFD1048576"><v>2</v></c></row>'


@pytest.mark.parametrize("cells", [TABLE + LAST, LAST])
def test_two_cells_of_a_spreadsheet_do_not_need_terabytes(tmp_path: Path, cells: str) -> None:
    """The library ends the process: a failure is the end of all tests."""
    path = tmp_path / "a.xlsx"
    sheet(path, TABLE)
    assert len(read_table(path).lines) == 8
    sheet(path, cells)
    refuse_table(path, "file.too_large")


def test_the_cells_of_all_sheets_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sheets, "MAX_CELLS", 17)
    book = Workbook()
    for each in (book.active, book.create_sheet("b")):
        for k in range(5):
            each.append([k, 2 * k])
    book.save(tmp_path / "a.xlsx")
    assert read_table(tmp_path / "a.xlsx", Format(sheet="b")).titles == ["1", "2"]
    monkeypatch.setattr(sheets, "MAX_CELLS", 19)
    refuse_table(tmp_path / "a.xlsx", "file.too_large")
