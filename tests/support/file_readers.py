"""Every reader of files and texts of strangers, with good ones: examples of the repository and what the readers write.

They are tried as the codecs of the wire are (`wire_codecs`), but a file has a longer time: `Reader.limit`.
"""

import io
import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
import xarray as xr
from fuzzing import Codec
from text_files import DRIFT, DRIFT_MAP, LOG, MAP, READINGS
from wire_readers import folder

from errormotion import datasets
from errormotion.campaign.files import load_bench, load_campaign
from errormotion.campaign.folder import SCHEMA as RUN_SCHEMA
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.storage.store import committed_length
from errormotion.datasets.certificates import ATTRIBUTE, certificates_of
from errormotion.datasets.clock import CLOCK, JOINS, age, notes
from errormotion.datasets.files import events
from errormotion.datasets.importing import import_files
from errormotion.datasets.tables.dates import Clock, zone_of
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.reading import read_table
from errormotion.datasets.text.readings_csv import read_csv
from errormotion.datasets.units import KINDS, convert
from errormotion.datasets.validation import validate
from errormotion.errors import ErrormotionError
from errormotion.instruments.controller.linuxcnc import bridge
from errormotion.instruments.interlock import Interlock
from errormotion.instruments.line_profiler.profile_files.readers import check_complete, read_scan
from errormotion.instruments.line_profiler.profile_files.settings import ProfileFileSettings
from errormotion.instruments.nc_limits import check_program
from errormotion.instruments.simulators.virtual_world.nc_program import interpret, title
from errormotion.instruments.transports.address import parse_address
from errormotion.plugins import MachineLimits
from errormotion.record.runs import index
from errormotion.record.runs.entry import read_entry
from errormotion.tolerances.table import load_tolerances

EXAMPLES = Path(__file__).parents[2] / "examples"
LIMIT = 0.1
"""CPU time of a file of up to some kilobytes, s; a line of text has the limit of a frame."""
MEMORY = 20 << 20
"""While a file of up to some kilobytes is read: 16 MiB are the largest file that a reader takes at once, bytes."""
TRAVEL = {"X": (-0.3, 0.3), "Y": (-0.3, 0.3), "Z": (-0.3, 0.3)}
GRID = ProfileFileSettings(unit="um", x_pitch=1e-5, y_pitch=1e-5)


@dataclass(frozen=True)
class Reader(Codec):
    """A reader of files.

    Attributes
    ----------
    limit : float
        CPU time of one file, s.
    """

    limit: float = LIMIT

    @property
    def memory(self) -> int:
        """Largest memory while a file is read, bytes."""
        return MEMORY


def named(name: str, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    """Return what reads bytes from a file of a name; warnings are errors, as a log has none to hide them."""
    place = folder() / name.replace(".", "-")

    def read_bytes(data: bytes) -> object:
        place.mkdir(exist_ok=True)
        path = place / name
        path.write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return read(path)

    return read_bytes


def text(read: Callable[[str], object]) -> Callable[[bytes], object]:
    """Return what reads bytes as a text."""
    return lambda data: read(data.decode("utf-8", "replace"))


def examples(name: str) -> list[bytes]:
    """Return the files of a name in the examples."""
    return [path.read_bytes() for path in sorted(EXAMPLES.glob(f"virtual_*/{name}"))]


def campaign(path: Path) -> object:
    """Read a campaign beside a bench of its kind."""
    (path.parent / "bench.toml").write_bytes((EXAMPLES / "virtual_tracker" / "bench.toml").read_bytes())
    return load_campaign(path)


TOLERANCES = """schema = "errormotion.tolerances/1"
[tolerances]
rule = "shared risk"
guard_factor = 0.8
[tolerances.freedoms]
EX = "5 um"
"E*Z" = {lower = "-3 um", upper = "10 um"}
[tolerances.figures]
"radial error motion" = {upper = "0.4"}
"""
HEIGHTS = b"# um\n1.5,,3.25,\n-4,5e1,0.125,\n7,8,9,\n"
PLY = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PCD = (
    b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
    b"POINTS 2\nDATA ascii\n"
)
PROGRAM = """%
(A straight line)
G21 G90 G94
G0 X0 Y0 Z10.
G1 Z-1.5 F600
POPEN
DPRNT[X#5021[33] Y#5022[33] Z#5023[33]]
G31 X12. F50
M3 S1200
G4 P1.5
PCLOS
M30
"""
RUN = {
    "schema": RUN_SCHEMA,
    "created": "2026-03-31T08:00:00+00:00",
    "bench": {"machine": "cframe"},
    "test": "warm-up",
    "method": {"id": "spindle_drift"},
    "campaign": {"name": "monday"},
    "status": "finished",
    "errors": "errors.nc",
    "results": [{"name": "EX", "value": 1e-6, "uncertainty": 1e-7, "unit": "um"}],
    "conformity": {"verdict": "conforms"},
    "tolerances": {},
    "steps": [],
}
NOTES = (
    '{"text": "spindle exchanged", "noted": "2026-03-31T08:00:00+00:00", "at": "2026-03-30T08:00:00+00:00"}\n'
    '{"text": "cold", "noted": "2026-03-31T08:00:00"}\nnot a note\n'
)
STORE = {
    "zarr_format": 3,
    "node_type": "group",
    "attributes": {},
    "consolidated_metadata": {"metadata": {"time": {"shape": [12], "dimension_names": ["time"]}}},
}
ATTRIBUTES = (
    b'[{"index": 3, "seconds": 1.5, "reason": "x", "time": null}]',
    b'{"wall": 1e9, "steady": 5.5, "boot": "a", "began": 1e9, "elapsed": 2.0}',
    b'{"bar": "K 17-2026"}',
)
REQUESTS = (
    '{"id": 1, "op": "hello", "version": 1, "control": true, "token": "ab"}',
    '{"id": 2, "op": "move_to", "position": [0.1, null, 0.3], "feed": 0.01}',
    '{"id": 3, "op": "set_pins", "pins": {"probe.ball.0.x": 1.5}}',
    "POST / HTTP/1.1",
)


def logs(path: Path, log: str, mapping: str) -> object:
    """Read a log with a map, of which one is at a path."""
    name = "map.toml" if path.suffix == ".txt" else "log.txt"
    other = path.with_name(name)
    other.write_text(mapping if name == "map.toml" else log)
    log_file, map_file = (path, other) if name == "map.toml" else (other, path)
    return import_files([log_file], map_file)


def readings(path: Path) -> None:
    """Read and check readings."""
    validate(read_csv(path))


def table(path: Path) -> None:
    """Read every number of a table."""
    found = read_table(path)
    mistakes = Mistakes(path)
    found.report(mistakes)
    found.numbers(dict(enumerate(found.titles)), mistakes)
    mistakes.raise_any()


def workbook() -> bytes:
    """Return a spreadsheet with three rows."""
    from openpyxl import Workbook

    book = Workbook()
    for row in (["t [s]", "a [um]"], [0, 1.5], [1, 1.6], [2, 1.7]):
        book.active.append(row)
    data = io.BytesIO()
    book.save(data)
    return data.getvalue()


def tdms() -> bytes:
    """Return a file of LabVIEW with two channels."""
    from nptdms import ChannelObject, TdmsWriter

    data = io.BytesIO()
    with TdmsWriter(data) as writer:
        writer.write_segment([ChannelObject("log", name, np.arange(4.0)) for name in ("t", "a")])
    return data.getvalue()


def run_file(path: Path) -> None:
    """Read the state of a run as the runner and as the record do."""
    both = (lambda: RunFolder.open(path.parent), lambda: read_entry(path.parent))
    errors = []
    for read in both:
        try:
            read()
        except ErrormotionError as error:
            errors.append(error)
    if errors:
        raise errors[-1]


def run_index(path: Path) -> None:
    """Read the index of runs of a folder."""
    index.load(path.parent)


@cache
def run_indices() -> Sequence[bytes]:
    """Return a good index."""
    entry = {"folder": "a", "created": "2026-03-31T08:00:00+00:00", "machine": "m", "test": "t", "method": "x"}
    rest = {"campaign": "c", "status": "finished", "errors": "errors.nc", "verdict": "", "figures": None, "notes": []}
    stamp = dict.fromkeys(index.STAMP, 1)
    return [json.dumps({"schema": index.SCHEMA, "runs": [{**entry, **rest, "unreadable": [], **stamp}]}).encode()]


def program(content: str) -> None:
    """Read a program as the interlock of a controller and the simulated control do."""
    title(content)
    errors = []
    interlock = Interlock("a controller", "sim://cframe")
    interlock.limits = MachineLimits(TRAVEL, None, 5000.0)
    for read in (lambda: check_program(content, interlock), lambda: interpret(content, (0.0, 0.0, 0.0), TRAVEL, 0.5)):
        try:
            read()
        except ErrormotionError as error:
            errors.append(error)
    if len(errors) == 2:
        raise errors[0]


def unit(name: str) -> None:
    """Read a unit, and a quantity with it."""
    for quantity in KINDS:
        try:
            quantity.parse(f"5 {name}")
        except ValueError as error:  # becomes a mistake of the file that states it
            if quantity.kind not in str(error):
                raise
    convert(1.0, name, "m")


def date(content: str) -> None:
    """Read a time in each form."""
    zone = zone_of("Europe/Berlin")
    for form in ("iso8601", "dd.mm.yyyy"):
        try:
            Clock(form, zone).seconds(content)
        except ValueError as error:  # becomes a mistake of the file that states it
            if content not in str(error):
                raise


def request(data: bytes) -> None:
    """Read a request to the bridge."""
    try:
        bridge.parse_request(data)
    except ValueError:  # the connection is closed
        return


def stated(content: str) -> None:
    """Read what attributes of a dataset state in JSON."""
    attrs = {JOINS: content, CLOCK: content}
    notes(attrs)
    with suppress(ValueError):
        age(xr.Dataset(attrs={**attrs, "start": "2026-03-31T08:00:00+00:00"}))
    certificates_of({ATTRIBUTE: content})


@cache
def classic() -> Sequence[bytes]:
    """Return NetCDF files of the classic format."""
    path = folder() / "classic-good.nc"
    numbers = np.arange(6.0)
    xr.Dataset({"a": ("time", numbers, {"units": "m"})}, {"time": numbers}, {"schema": "x"}).to_netcdf(
        path, engine="scipy", format="NETCDF3_64BIT"
    )
    return [path.read_bytes()]


READERS: Sequence[Reader] = (
    Reader("file", "bench", named("bench.toml", load_bench), partial(examples, "bench.toml"), 4096),
    Reader("file", "campaign", named("campaign.toml", campaign), partial(examples, "campaign.toml"), 4096),
    Reader("file", "tolerances", named("limits.toml", load_tolerances), lambda: [TOLERANCES.encode()], 4096),
    Reader(
        *("file", "log", named("a.txt", partial(logs, log="", mapping=MAP)), lambda: [LOG.encode()]),
        4096,
        limit=0.2,
    ),
    Reader("file", "map of a log", named("a.toml", partial(logs, log=LOG, mapping="")), lambda: [MAP.encode()], 4096),
    Reader(
        *("file", "log of drift", named("b.txt", partial(logs, log="", mapping=DRIFT_MAP)), lambda: [DRIFT.encode()]),
        4096,
    ),
    Reader(
        *("file", "map of drift", named("b.toml", partial(logs, log=DRIFT, mapping="")), lambda: [DRIFT_MAP.encode()]),
        4096,
    ),
    Reader("file", "spreadsheet", named("a.xlsx", table), lambda: [workbook()], 1 << 14),
    Reader("file", "TDMS", named("a.tdms", table), lambda: [tdms()], 4096),
    Reader("file", "readings", named("readings.csv", readings), lambda: [READINGS.encode()], 4096),
    Reader("file", "heights", named("scan.csv", partial(read_scan, settings=GRID)), lambda: [HEIGHTS], 4096),
    Reader(
        *("file", "point cloud", named("scan.ply", check_complete)),
        *(lambda: [PLY + b"0 0 0.1\n1 1 0.2\n", PCD + b"0 0 0.1\n1 1 0.2\n"], 4096),
    ),
    Reader("file", "run.json", named("run.json", run_file), lambda: [json.dumps(RUN).encode()], 4096),
    Reader("file", "index of runs", named(index.FILE, run_index), run_indices, 4096),
    Reader("file", "notes", named(events.FILE, lambda path: events.read(path.parent)), lambda: [NOTES.encode()], 4096),
    Reader(
        *("file", "state of a store", named("zarr.json", lambda path: committed_length(path.parent, "time"))),
        *(lambda: [json.dumps(STORE).encode()], 4096),
    ),
    Reader("file", "classic NetCDF", named("classic.nc", datasets.load), classic, 4096),
    Reader("text", "program", text(program), lambda: [PROGRAM.encode()], 4096),
    Reader(
        "text", "unit", text(unit), lambda: [b"mm", b"W m-2 K-1", b"um/degC", b"kg m\xc2\xb2/s\xc2\xb2", b"1/min"], 256
    ),
    Reader("text", "time", text(date), lambda: [b"2024-05-31T14:05:09.25+02:00", b"27.10.2024 02:30:09,5 PM"], 256),
    Reader(
        *("text", "address", text(parse_address)),
        *(lambda: [b"tcp://192.168.0.2:23?a=1", b"modbus+rtu:///dev/ttyUSB0?baudrate=9600&unit=1"], 1024),
    ),
    Reader("text", "attributes", text(stated), lambda: [*ATTRIBUTES], 4096),
    Reader("text", "request to the bridge", request, lambda: [each.encode() for each in REQUESTS], 4096),
)
