"""The registry finds plugins of any distribution, and a broken plugin does not affect others."""

import sys

import pytest
import xarray as xr
from coded import raises

from errormotion import plugins
from errormotion.datasets import schemas
from errormotion.datasets.validation import checked_raw
from errormotion.errors import DatasetError, PluginError, PluginWarning

GOOD = """
from errormotion.plugins import InstrumentInfo, PluginSettings

class Good:
    info = InstrumentInfo("{id}", "point_lds", "A sensor from elsewhere", "simulated_only")
    Settings = PluginSettings
    def open(self): ...
    def close(self): ...
    def identify(self): ...
    def read(self): ...
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a distribution on the path as installed by pip: a dist-info folder and a module."""

    names = []

    def install(name, entry_points, module=""):
        names.append(name)
        folder = tmp_path / name
        info = folder / f"{name}-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(entry_points)
        (folder / f"{name}.py").write_text(module)
        monkeypatch.syspath_prepend(folder)
        plugins.refresh()
        return folder

    yield install
    monkeypatch.undo()
    for name in names:
        sys.modules.pop(name, None)
    plugins.refresh()


def instrument(plugin_id, target):
    return f"[errormotion.instruments]\n{plugin_id} = {target}\n"


def by_id(group="instruments"):
    return {plugin.id: plugin for plugin in plugins.available(group)}


def test_the_built_in_plugins_are_registered_by_entry_points():
    assert {"optoncdt", "five_sensor_frame", "virtual_controller", "dcon_temperature"} <= by_id().keys()
    assert "spindle_drift" in by_id("methods")
    assert by_id()["optoncdt"].distribution.startswith("errormotion ")


def test_another_plugin_is_listed_with_its_distribution(install):
    install("elsewhere", instrument("good", "elsewhere:Good"), GOOD.format(id="good"))
    plugin = by_id()["good"]
    assert (plugin.error, plugin.distribution) == ("", "elsewhere 1.2")
    assert plugins.get("instruments", "good") is plugin.cls


@pytest.mark.parametrize(
    ("module", "complaint"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("class Good: pass", "expected a class with an `info` of type InstrumentInfo, found None"),
        ("Worse = 1", "AttributeError"),
        (GOOD.format(id="better"), "the entry point is called 'broken', but the id of the class is 'better'"),
        (GOOD.format(id="broken").replace("def read", "def reed"), "class Good lacks read"),
        ("def", "SyntaxError"),
    ],
)
def test_a_broken_plugin_is_listed_with_its_error_and_affects_no_other(install, module, complaint):
    install("elsewhere", instrument("good", "elsewhere:Good"), GOOD.format(id="good"))
    install("wreck", instrument("broken", "wreck:Good"), module)
    listed = by_id()
    assert listed["good"].error == ""
    assert complaint in listed["broken"].error
    assert listed["broken"].traceback.startswith("Traceback")
    with pytest.raises(PluginError, match=r"'broken' \(wreck 1.2\) does not load"):
        plugins.get("instruments", "broken")


def test_an_unreadable_list_of_entry_points_is_reported_and_affects_no_other(install):
    install("scrawl", "[errormotion.instruments]\nthis line has no equals sign\n")
    assert "entry_points.txt cannot be read" in by_id()["scrawl"].error
    assert "optoncdt" in by_id()


def test_a_folder_without_metadata_affects_no_plugin(install):
    folder = install("bare", instrument("good", "bare:Good"), GOOD.format(id="good"))
    (folder / "bare-1.2.dist-info" / "METADATA").unlink()
    plugins.refresh()
    assert by_id()["good"].error == ""
    assert "optoncdt" in by_id()


def test_two_distributions_with_one_id_are_both_named(install):
    install("one", instrument("good", "one:Good"), GOOD.format(id="good"))
    install("two", instrument("good", "two:Good"), GOOD.format(id="good"))
    rivals = [plugin for plugin in plugins.available("instruments") if plugin.id == "good"]
    assert len(rivals) == 2
    assert all("one 1.2" in plugin.error and "two 1.2" in plugin.error for plugin in rivals)
    with raises("plugin.ambiguous"):
        plugins.get("instruments", "good")


def test_of_two_copies_the_first_on_the_path_is_used_even_without_plugins(install, tmp_path, monkeypatch):
    install("copied", instrument("copied_sensor", "copied:Good"), GOOD.format(id="copied_sensor"))
    assert "copied_sensor" in by_id()
    first = tmp_path / "first" / "copied-1.3.dist-info"
    first.mkdir(parents=True)
    (first / "METADATA").write_text("Metadata-Version: 2.1\nName: copied\nVersion: 1.3\n")
    monkeypatch.syspath_prepend(first.parent)
    plugins.refresh()
    assert "copied_sensor" not in by_id()


def test_an_unknown_id_names_the_nearest():
    with pytest.raises(PluginError, match=r"Did you mean 'optoncdt'\?"):
        plugins.get("instruments", "optonct")


def test_getting_one_plugin_loads_no_other(install):
    install("elsewhere", instrument("good", "elsewhere:Good"), GOOD.format(id="good"))
    install("bystander", instrument("other", "bystander:Good"), GOOD.format(id="other"))
    plugins.get("instruments", "good")
    assert "bystander" not in sys.modules


def test_a_newly_installed_plugin_is_found_after_a_refresh(install, tmp_path):
    folder = install("elsewhere", "", GOOD.format(id="late"))
    assert "late" not in by_id()
    (folder / "elsewhere-1.2.dist-info" / "entry_points.txt").write_text(instrument("late", "elsewhere:Good"))
    assert "late" not in by_id()
    plugins.refresh()
    assert by_id()["late"].error == ""


DATASET = """
from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy

class Kind(DatasetPlugin):
    info = DatasetInfo("broken", "A kind of dataset with a part that does not load", ("lab.broken/1",))
    raw_schemas = {tables}
    log_readers = lazy("wreck_readers:READERS")
"""


@pytest.mark.parametrize("tables", ['lazy("no_such_module:TABLES")', 'lazy("wreck:UNKNOWN")', "lazy('nothing')"])
def test_tables_of_a_plugin_that_cannot_be_loaded_are_ignored_with_a_warning(install, tables):
    install("wreck", "[errormotion.datasets]\nbroken = wreck:Kind\n", DATASET.format(tables=tables))
    with pytest.warns(PluginWarning, match="The plugin 'broken': `raw_schemas` is ignored"):
        known = schemas.known_schemas()
    assert {"errormotion.errors/1", "errormotion.raw.spindle_drift/1", "lab.broken/1"} <= known
    assert plugins.owner_of_schema("lab.unknown/1") is None
    assert plugins.owner_of_schema("errormotion.raw.spindle_drift/1").info.id == "spindle_drift"


def test_tables_that_are_not_schemas_are_ignored(install):
    install("wreck", "[errormotion.datasets]\nbroken = wreck:Kind\n", DATASET.format(tables="(1, 'text')"))
    assert {"errormotion.errors/1", "errormotion.raw.spindle_drift/1"} <= schemas.known_schemas()
    assert plugins.owner_of_schema("lab.unknown/1") is None


METHOD = """
from errormotion.plugins import {imported}MethodInfo, Needs, PluginSettings

class Old{base}:
    info = MethodInfo("old", "A method", "simulated_only")
    needs = Needs((), "lab.raw.old/1")
    Settings = PluginSettings
    def acquire(self, bench, settings, *, inputs, done=None): ...
    def append_dim(self, settings): return "time"
    def progress(self, settings): return 1.0
    def identify(self, raw, settings): return raw
    def programs(self, settings, instruments): return {{"a.nc": "M2"}}
"""
PLAN = "    def plan(self, settings): return settings\n"


def test_a_method_of_the_old_form_has_the_optional_parts_and_a_warning(install):
    install("old", "[errormotion.methods]\nold = old:Old\n", METHOD.format(imported="", base="") + PLAN)
    with pytest.warns(PluginWarning, match=r"'old' does not extend errormotion.plugins.Method; from version 0.3"):
        old = plugins.get("methods", "old")
    assert issubclass(old, plugins.Method)
    assert old().motions(None, {}) is None
    assert old().planning_settings("its", {}) == "its"
    assert [plugins.states(old, name) for name in ("programs", "motions", "figures")] == [True, False, False]


def test_parts_that_the_base_class_only_declares_are_required(install):
    install("new", "[errormotion.methods]\nold = new:Old\n", METHOD.format(imported="Method, ", base="(Method)"))
    with pytest.raises(PluginError, match="class Old lacks plan"):
        plugins.get("methods", "old")
    with pytest.raises(AttributeError, match="plugins have no part 'motion'"):
        plugins.states(plugins.Method, "motion")


RENAMED = """
import xarray as xr
from errormotion.datasets.schemas import RawSchema, Row
from errormotion.plugins import Method, MethodInfo, Needs, PluginSettings

class Renamed(Method):
    info = MethodInfo("new_drift", "A method that was called old_drift", "simulated_only", former=("old_drift",))
    needs = Needs((), "errormotion.raw.new_drift/1")
    Settings = PluginSettings
    raw_schemas = (
        RawSchema("errormotion.raw.new_drift/1", "", "reading", (Row("reading", ("time",), "m", 0.0, 1.0, "it"),)),
    )
    def acquire(self, bench, settings, *, inputs, done=None): ...
    def append_dim(self, settings): return "time"
    def progress(self, settings): return 1.0
    def identify(self, raw, settings): return raw
    def plan(self, settings): return settings
"""


@pytest.fixture
def renamed(install):
    """Install a method with a former name."""
    install("renamed", "[errormotion.methods]\nnew_drift = renamed:Renamed\n", RENAMED)
    return r"The method 'old_drift' is called 'new_drift' now\."


@pytest.mark.parametrize(
    ("door", "name"),
    [
        (lambda name: plugins.get("methods", name), "old_drift"),
        (plugins.owner_of_method, "old_drift"),
        (plugins.owner_of_schema, "errormotion.raw.old_drift/1"),
    ],
    ids=["get", "owner_of_method", "owner_of_schema"],
)
def test_a_former_name_of_a_method_finds_it_with_a_warning(renamed, door, name):
    with pytest.warns(PluginWarning, match=renamed):
        found = door(name)
    assert found.info.id == "new_drift"


def test_the_raw_data_of_a_former_name_follow_the_present_tables(renamed):
    old = "errormotion.raw.old_drift/1"
    with pytest.warns(PluginWarning, match=renamed):
        assert [table.id for table in schemas.variants(old)] == ["errormotion.raw.new_drift/1"]
    raw = xr.Dataset({"reading": ("time", [0.5], {"units": "m"})}, attrs={"schema": old})
    assert checked_raw(raw, plugins.get("methods", "new_drift")()).attrs["schema"] == old
    with pytest.raises(DatasetError, match=r"reading = 5 m: expected 0\.\.1 m"):
        checked_raw((raw * 10).assign_attrs(raw.attrs), plugins.get("methods", "new_drift")())
    assert schemas.variants("errormotion.raw.old_drift/2") == ()


def test_a_plugin_precedes_the_former_name_of_another_one(renamed, install):
    source = RENAMED.replace("new_drift", "old_drift").replace(', former=("old_drift",)', "")
    install("kept", "[errormotion.methods]\nold_drift = kept:Renamed\n", source)
    for found in (
        plugins.get("methods", "old_drift"),
        plugins.owner_of_method("old_drift"),
        plugins.owner_of_schema("errormotion.raw.old_drift/1"),
    ):
        assert found.info.id == "old_drift"
