"""``check_plugin`` finds the subjects, runs all checks, and reports missing subjects."""

from types import SimpleNamespace

import pytest
from coded import raises

from errormotion import plugins
from errormotion.errors import PluginError
from errormotion.plugins import InstrumentInfo, Method, MethodInfo, MethodSubject
from errormotion.testing import InstrumentSubject, check_plugin, run_checks
from errormotion.testing.run import subjects_of


@pytest.fixture
def registered(monkeypatch):
    """Put a class into the registry, under its id."""

    def register(**attributes):
        cls = type("Foreign", (), attributes)
        monkeypatch.setattr(plugins, "get", lambda group, plugin_id: cls)
        return cls

    return register


def test_runs_all_checks_and_reports_which_do_not_apply():
    results = check_plugin("instruments", "dcon_temperature")
    assert all(result.ok for result in results)
    assert {result.name for result in results if result.skipped} == {
        *("stream_blocks", "monotonic_time", "counted_drops", "refusals")
    }


def test_some_checks_are_run_alone():
    found = check_plugin("instruments", "dcon_temperature", only=("readings", "identify"))
    assert [result.name for result in found] == ["identify", "readings"]
    with raises("check.unknown"):
        check_plugin("instruments", "dcon_temperature", only=("reading",))


def test_an_address_replaces_the_simulator():
    (subject,) = subjects_of("instruments", "dcon_temperature", address="sim://cframe?seed=8")
    assert subject.address == "sim://cframe?seed=8"


def test_a_plugin_states_its_subjects(registered, tmp_path, monkeypatch):
    (tmp_path / "mine_kit.py").write_text(
        "from errormotion.testing import MethodSubject\n"
        "ONE, TWO = (MethodSubject(None, None, {}, name=name) for name in ('one', 'two'))\n"
        "BOTH = (ONE, TWO)\n"
        "NONE = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    info = MethodInfo("mine", "", "simulated_only")
    registered(info=info, conformance="mine_kit:ONE")
    assert [subject.name for subject in subjects_of("methods", "mine")] == ["one"]
    registered(info=info, conformance="mine_kit:BOTH")
    assert [subject.name for subject in subjects_of("methods", "mine")] == ["one", "two"]
    registered(info=info, conformance="mine_kit:NONE")
    with pytest.raises(PluginError, match="expected MethodSubject"):
        subjects_of("methods", "mine")


def test_a_method_without_subjects_is_reported_with_a_remedy(registered):
    registered(info=MethodInfo("mine", "", "simulated_only"))
    with raises("check.subject.missing"):
        subjects_of("methods", "mine")


def test_a_method_with_the_base_class_may_state_no_subject_or_a_method_that_makes_them(monkeypatch):
    class Bare(Method):
        info = MethodInfo("mine", "", "simulated_only")

    class Own(Bare):
        def conformance(self):
            return (MethodSubject(type(self), None, {}),)

    monkeypatch.setattr(plugins, "get", lambda group, plugin_id: Bare)
    with raises("check.subject.missing"):
        subjects_of("methods", "mine")
    monkeypatch.setattr(plugins, "get", lambda group, plugin_id: Own)
    assert [subject.plugin for subject in subjects_of("methods", "mine")] == [Own]


def test_an_instrument_without_simulator_needs_an_address(registered):
    registered(info=InstrumentInfo("mine", "point_lds", "", "hardware_verified"))
    with raises("check.simulator.missing"):
        subjects_of("instruments", "mine")
    (subject,) = subjects_of("instruments", "mine", address="tcp://127.0.0.1:9")
    assert not subject.simulated


def test_an_unknown_plugin_is_named_with_the_nearest():
    with raises("plugin.unknown"):
        check_plugin("instruments", "optonct")


def test_a_simulator_that_cannot_be_loaded_fails_only_its_checks():
    info = InstrumentInfo("mine", "point_lds", "A sensor of nobody", "simulated_only", simulator="no_such:Device")
    subject = InstrumentSubject(SimpleNamespace(info=info), "sim://cframe")
    results = {result.name: result for result in run_checks(subject)}
    assert "'no_such:Device' does not load" in results["info_complete"].message
    assert not any(result.ok for name, result in results.items() if name in ("info_complete", "faults"))
