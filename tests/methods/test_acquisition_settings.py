"""Settings of the acquisition: a method that names them does not use them for the identification."""

from typing import Any

import pytest

from errormotion import plugins
from errormotion.datasets import provenance
from errormotion.plugins import MethodSubject

SLOW = {"crossbeam_scan", "multilateration", "spindle_drift"}
METHODS = [
    each.cls
    for each in plugins.available("methods")
    if each.cls is not None and each.distribution.startswith("errormotion ")
]
SUBJECTS = [
    pytest.param(subject, id=f"{method.info.id} {subject.name}", marks=[pytest.mark.slow] * (method.info.id in SLOW))
    for method in METHODS
    if method.acquisition_settings
    for subject in method().conformance()
]


def watched(settings: Any, read: set[str]) -> Any:
    """Return settings that note which of their fields are read."""

    class Watched(type(settings)):  # type: ignore[misc]
        def __getattribute__(self, name: str) -> Any:
            if name in type(settings).model_fields:
                read.add(name)
            return object.__getattribute__(self, name)

    values = {name: getattr(settings, name) for name in type(settings).model_fields}
    return Watched.model_construct(_fields_set=settings.model_fields_set, **values)


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.info.id)
def test_settings_of_the_acquisition_exist(method: Any) -> None:
    assert set(method.acquisition_settings) <= set(method.Settings.model_fields)


@pytest.mark.parametrize("subject", SUBJECTS)
def test_identification_reads_no_setting_of_the_acquisition(subject: MethodSubject) -> None:
    read = set[str]()
    raw, _ = subject.make(1)
    subject.warm_up()
    subject.plugin().identify(raw, watched(subject.effective_settings(), read))
    assert sorted(read & set(subject.plugin.acquisition_settings)) == []


@pytest.mark.parametrize("subject", [s for s in SUBJECTS if not s.marks])
def test_the_result_of_imported_data_states_no_default_of_the_acquisition(subject: MethodSubject) -> None:
    raw, _ = subject.make(1)
    names = set(subject.plugin.acquisition_settings)
    settings = subject.effective_settings()
    measured = provenance.of(subject.plugin().identify(raw, settings))["settings"]
    imported = provenance.of(subject.plugin().identify(raw.assign_attrs(imported="a.csv"), settings))["settings"]
    assert names <= set(measured)
    assert set(imported) & names == names & settings.model_fields_set
    assert {name: each for name, each in measured.items() if name not in names} == {
        name: each for name, each in imported.items() if name not in names
    }
