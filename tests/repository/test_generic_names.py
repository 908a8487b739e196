"""Generic code names no plugin: code for a method, an instrument or a kind of dataset is in its folder."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
GROUPS = ("instruments", "methods", "datasets", "compensators")
ENTRY_POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
HOMES = {
    plugin_id: value.partition(":")[0].rpartition(".")[0].replace(".", "/")
    for group in GROUPS
    for plugin_id, value in ENTRY_POINTS[f"errormotion.{group}"].items()
}
#: Folder of the package with examples: campaigns and benches, and their programs.
EXAMPLES = "errormotion/cli/demo/"
#: Words that are ids and also have another meaning: variables of published datasets, the command of a package, and
#: defaults of published settings that name another plugin; the package of thermal models; a format of tables;
#: a simulated server on the parts of another; a control.
OTHER_MEANINGS = {
    ("optoncdt", "errormotion/instruments/spindle_frame/"),
    ("optoncdt", "errormotion/instruments/simulators/spindle_frame/"),
    ("virtual_controller", "errormotion/instruments/touch_probe/controller_probe.py"),
    ("beam_direction", "errormotion/methods/spindle_drift/"),
    ("beam_direction", "errormotion/instruments/"),
    ("beam_direction", "errormotion/report/parts/beams.py"),
    ("thermal_model", "errormotion/cli/commands/compensation/model.py"),
    ("thermal_model", "errormotion/compensation/"),
    ("linuxcnc", "errormotion/compensation/tables/formats/linuxcnc.py"),
    ("linuxcnc", "errormotion/instruments/compensator/linuxcnc.py"),
    ("opcua", "errormotion/instruments/simulators/compensator/nodes.py"),
}


NAME = re.compile(rf"(?<![A-Za-z0-9_])(?:{'|'.join(map(re.escape, HOMES))})(?![A-Za-z0-9_])")


def named(path: Path, text: str) -> list[str]:
    """Return the ids that a file outside of their folders names."""
    place = path.relative_to(ROOT).as_posix()
    if place.startswith(EXAMPLES):
        return []
    found = []
    for plugin_id in sorted(set(NAME.findall(text))):
        home = HOMES[plugin_id]
        # The simulators of a kind of instrument have a folder beside those of the drivers.
        simulators = "/".join(home.split("/")[:3]).replace("instruments/", "instruments/simulators/")
        if place.startswith((f"{home}/", f"{home}.", f"{simulators}/")):
            continue
        if any(word == plugin_id and place.startswith(folder) for word, folder in OTHER_MEANINGS):
            continue
        found.append(plugin_id)
    return found


def test_a_file_names_only_the_plugins_of_its_own_folder() -> None:
    paths = sorted((ROOT / "errormotion").rglob("*.py"))
    assert len(paths) > 500
    found = {path.relative_to(ROOT).as_posix(): named(path, path.read_text()) for path in paths}
    assert {place: ids for place, ids in found.items() if ids} == {}
