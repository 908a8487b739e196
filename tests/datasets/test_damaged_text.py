"""Damaged text files: every mutant is read, or refused with an error of the package, in limited time."""

import warnings
from collections.abc import Callable
from pathlib import Path

import mutants
import pytest
from text_files import DRIFT, DRIFT_MAP, LOG, MAP, READINGS

from errormotion.datasets.importing import import_log
from errormotion.datasets.storage.disk import load
from errormotion.datasets.tables.dates import Clock, zone_of
from errormotion.datasets.units import KINDS, convert
from errormotion.errors import DatasetError


@pytest.fixture
def reader(tmp_path: Path) -> Callable[..., Callable[[bytes], object]]:
    """Return a function that makes readers: of the log, or of its map."""

    def reader(log: str, mapping: str, which: str) -> Callable[[bytes], object]:
        texts = {"log.csv": log.encode(), "map.toml": mapping.encode()}

        def read(data: bytes) -> object:
            for name, text in texts.items():
                (tmp_path / name).write_bytes(data if name == which else text)
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                return import_log(tmp_path / "log.csv", tmp_path / "map.toml", tmp_path / "raw.nc", overwrite=True)

        return read

    return reader


@pytest.mark.parametrize("which", ["log.csv", "map.toml"])
@pytest.mark.parametrize(("log", "mapping"), [(LOG, MAP), (DRIFT, DRIFT_MAP)], ids=["any schema", "drift"])
def test_damaged_logs_and_maps(reader, log: str, mapping: str, which: str) -> None:
    data = (log if which == "log.csv" else mapping).encode()
    refused = mutants.check(reader(log, mapping, which), data, seed=1, number=mutants.count(120))
    assert refused > 48  # of changes to a file of this kind most are mistakes


def test_damaged_readings(tmp_path: Path) -> None:
    def read(data: bytes) -> object:
        (tmp_path / "readings.csv").write_bytes(data)
        return load(tmp_path / "readings.csv")

    assert mutants.check(read, READINGS.encode(), seed=2, number=mutants.count(250)) > 100


def test_damaged_units_and_quantities() -> None:
    def read(data: bytes) -> None:
        text = data.decode("utf-8", "replace")
        for target in ("m", "K", "1", "1/min"):
            try:
                convert(1.0, text, target)
            except DatasetError:
                continue
        for quantity in KINDS:
            message = ""
            try:
                quantity.parse(f"5 {text}")
            except ValueError as error:
                message = str(error)
            assert not message or f"expected {quantity.kind} with its unit" in message

    for seed, unit in enumerate(("mm", "W m-2 K-1", "um/degC", "1/min", "m.s-1", "degC", "kg·m²/s²")):
        mutants.check(read, unit.encode(), seed=seed, number=mutants.count(60), limit=2.0)


@pytest.mark.parametrize(
    ("unit", "text"), [("iso8601", "2024-05-31T14:05:09.25+02:00"), ("dd.mm.yyyy", "27.10.2024 02:30:09,5 PM")]
)
def test_damaged_dates(unit: str, text: str) -> None:
    def read(data: bytes) -> None:
        clock = Clock(unit, zone_of("Europe/Berlin"))
        for each in (text.replace("02:30", "01:30"), data.decode("utf-8", "replace")):
            message = each
            try:
                clock.seconds(each)
            except ValueError as error:
                message = str(error)
            assert each in message

    mutants.check(read, text.encode(), seed=3, number=mutants.count(1000), limit=1.0)
