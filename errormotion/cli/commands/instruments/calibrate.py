"""``errormotion calibrate``: makes a calibration from readings, by the plugin that owns their schema."""

from __future__ import annotations

from pathlib import Path

from errormotion import datasets, plugins
from errormotion.cli.options import read_settings
from errormotion.cli.output import show, show_json
from errormotion.cli.page import new_dataset
from errormotion.cli.progress import Bars
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.validation import explained
from errormotion.errors import DatasetError
from errormotion.plugins import Calibration


def run(data: Path, out: Path, assignments: list[str], settings_file: Path | None, as_json: bool) -> None:
    """Make a calibration and write it to a new file.

    Raises
    ------
    DatasetError
        The data cannot be read or have no schema of a calibration, or the file already exists.
    MethodError
        The settings are invalid, or the readings do not determine a calibration.
    """
    new_dataset(out)
    with Bars(as_json) as bars, reading(data), datasets.load(data) as raw:
        calibration = _calibration_of(data, str(raw.attrs.get("schema", "none")))
        settings = read_settings(calibration.Settings, settings_file, assignments)
        bars.stage("calibrating")
        with explained(data, raw):
            result = calibration.make(raw, settings)
    datasets.save(result, out)
    if as_json:
        show_json({"ok": True, "calibration": str(out), **calibration.figures(result)})
        return
    heading, *lines = calibration.text(result)
    show(f"{out}: {heading}")
    for line in lines:
        show(f"  {line}")


def _calibration_of(data: Path, schema: str) -> Calibration:
    """Return the calibration that evaluates readings of a schema."""
    owner = plugins.owner_of_schema(schema)
    found: Calibration | None = None if owner is None else owner.calibrations.get(schema)
    if found is None:
        known = {name for _, made in plugins.brought("calibrations", "methods", "datasets") for name in made}
        raise DatasetError(f"{data}: expected schema {' or '.join(sorted(known))}; found {schema}", code="schema.other")
    return found
