"""Groups of sources of uncertainty have one name for one meaning, and stored results with earlier names are read."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets, plugins
from errormotion.datasets.groups import ALIASES, GROUPS, present
from errormotion.testing.run import subjects_of

TOOL = Path(__file__).parents[2] / "tools" / "source_groups.py"
BUILT_IN = [each.id for each in plugins.available("methods") if each.distribution.startswith("errormotion ")]


@pytest.mark.parametrize("method", BUILT_IN)
def test_a_result_has_groups_of_the_table(method: str) -> None:
    cls = plugins.get("methods", method)
    for subject in subjects_of("methods", method):
        raw, _ = subject.make(0)
        errors = cls().identify(raw, cls.Settings.model_validate(subject.settings))
        found = set(map(str, errors["source_group"].values)) if "source_group" in errors.coords else set()
        assert found - {present(name) for name in found & ALIASES.keys()} <= GROUPS.keys() | ALIASES.keys(), (
            subject.name
        )


def test_the_list_states_a_user_of_every_group() -> None:
    rows = [line for line in runpy.run_path(str(TOOL))["table"]().splitlines() if line.startswith("| ")]
    assert len(rows) == len(ALIASES) + len(GROUPS) + 2
    assert not [row for row in rows if row.endswith("|  |")]


def test_an_earlier_name_is_no_present_one() -> None:
    assert not ALIASES.keys() & GROUPS.keys()
    assert set(ALIASES.values()) <= GROUPS.keys()


def test_stored_results_with_earlier_names_are_read(tmp_path: Path) -> None:
    old = datasets.build_errors(
        np.zeros((3, 6)),
        np.tile(np.eye(6) * 1e-12, (3, 1, 1)),
        dims=("time",),
        coords={"time": ("time", [0.0, 1.0, 2.0], {"units": "s"})},
        component="tool",
        machine="mill",
        frame="machine",
        functional_point=[0.0, 0.0, 0.0],
        reference="commanded",
        method="multilateration",
        method_version="1",
        provenance={},
        influence=np.full((3, 3, 6), 1e-7),
        sources=["one", "two", "three"],
        source_groups=["air", "tracker", "own group"],
    )
    datasets.save(old, tmp_path / "old.nc")
    read = datasets.load(tmp_path / "old.nc")
    assert list(read["source_group"].values) == ["refraction", "scale of the tracker", "own group"]
    assert "refraction" in read.em.budget()["group"].values
    np.testing.assert_array_equal(read["influence"], old["influence"])
