"""Limits are checked with the key of each mistake, and decide on figures and freedoms of any method."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets, plugins
from errormotion.datasets import provenance
from errormotion.errors import BenchError
from errormotion.plugins import FigureOfMerit, Method
from errormotion.report import write_report
from errormotion.tolerances.conformity import judge, matches
from errormotion.tolerances.decision import INSIDE, OPEN, OUTSIDE
from errormotion.tolerances.table import Tolerances, from_run, load_tolerances

HEAD = 'schema = "errormotion.tolerances/1"\n[tolerances]\n'


def limits(tmp_path: Path, text: str) -> Tolerances:
    file = tmp_path / "limits.toml"
    file.write_text(HEAD + text)
    return load_tolerances(file)


@pytest.fixture
def errors() -> xr.Dataset:
    """EX of 0, 3 and 5 um and EA of 10 urad, U = 1 um and 2 urad; the last EA and all EY are unknown."""
    values = np.full((3, 6), np.nan)
    values[:, 0], values[:2, 3] = [0.0, 3e-6, 5e-6], 10e-6
    return datasets.build_errors(
        values,
        np.tile(np.diag([0.25e-12, 1e-12, 1e-12, 1e-12, 1e-12, 1e-12]), (3, 1, 1)),
        dims=("time",),
        coords={"time": [0.0, 60.0, 120.0]},
        component="tool",
        machine="m",
        frame="machine",
        functional_point=np.zeros(3),
        reference="cold",
        method="foreign",
        method_version="1",
        provenance=provenance.make({}, None, None),
    )


class Foreign(Method):
    """The method of another distribution."""

    @staticmethod
    def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
        return [FigureOfMerit("G(CW), run 1", 5e-6, 1e-6, "m"), FigureOfMerit("hysteresis", 0.2, 0.01, "1")]


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "owner_of_method", {"foreign": Foreign}.get)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "tolerances: expected limits in 'figures', 'freedoms' or both; found none"),
        ('freedoms = { EX = "10" , EY = 5 }', "tolerances.freedoms.EY: expected a limit with its unit in quotes"),
        ('freedoms = { EX = "10 bananas" }', "tolerances.freedoms.EX: expected a limit with its unit"),
        ('freedoms = { EX = "-10 um" }', "above 0 for the absolute value; found '-10 um'"),
        ('freedoms = { EX = "nan" }', "tolerances.freedoms.EX"),
        ('freedoms = { EX = { lower = "5 um", upper = "1 um" } }', "expected 'lower' below 'upper'"),
        (
            'freedoms = { EX = { lower = "5 um", upper = "1 rad" } }',
            "same unit for 'lower' and 'upper'; found m and rad",
        ),
        ("freedoms = { EX = {} }", "expected 'lower', 'upper' or both"),
        ('freedoms = { EX = { uper = "5 um" } }', "did you mean 'upper'?"),
        ('rule = "iso14253"\nfreedoms = { EX = "1 um" }', "tolerances.rule: expected 'iso 14253-1'"),
        ('guard_factor = -1.0\nfreedoms = { EX = "1 um" }', "tolerances.guard_factor"),
        ('guard_factor = nan\nfreedoms = { EX = "1 um" }', "tolerances.guard_factor"),
    ],
)
def test_each_mistake_is_reported_with_file_and_key(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(BenchError) as failure:
        limits(tmp_path, text)
    assert str(failure.value).startswith(f"{tmp_path / 'limits.toml'}: 1 mistake")
    assert expected in str(failure.value)


def test_limits_are_read_in_any_unit(tmp_path: Path) -> None:
    found = limits(tmp_path, 'freedoms = { EX = "10 um", EA = { upper = "1 arcsec" } }\nfigures = { "h*" = "0.3" }')
    assert found.freedoms["EX"].interval == pytest.approx((-1e-5, 1e-5))
    assert found.freedoms["EA"].interval == pytest.approx((-np.inf, np.pi / 648000))
    assert (found.figures["h*"].unit, found.figures["h*"].interval) == ("1", (-0.3, 0.3))


def test_stored_limits_are_those_that_were_read(tmp_path: Path) -> None:
    found = limits(tmp_path, 'rule = "simple"\nfreedoms = { EX = "10 um", EA = { upper = "1 arcsec" } }')
    stored = json.loads(json.dumps({"tolerances": found.model_dump(mode="json")}))
    assert from_run(stored) == found
    assert from_run({"tolerances": None}) is None
    with pytest.raises(BenchError, match=r"run\.json"):
        from_run({"tolerances": {"rule": 3}})


def test_figures_of_a_foreign_method_are_decided(tmp_path: Path, errors: xr.Dataset, foreign: None) -> None:
    table = limits(tmp_path, 'figures = { "G(CW)*" = "7 um", hysteresis = "0.205", other = "1 um" }')
    found = judge(errors, table)
    assert [(row.name, row.decision) for row in found.rows] == [("G(CW), run 1", INSIDE), ("hysteresis", OPEN)]
    assert found.unused == ("other",)
    assert found.verdict == "neither proved"
    assert found.lines()[0] == (
        "Tolerances: neither proved (ISO 14253-1, guard band 1 U (k = 2)); of 2 limits: "
        "1 neither proved, 1 conformity proved."
    )
    assert "G(CW), run 1: 5 um, U = 1 um, limits ±7 um: conformity proved" in found.lines()


@pytest.mark.parametrize(
    ("limit", "expected"), [("3.9 um", OUTSIDE), ("4.1 um", OPEN), ("5.9 um", OPEN), ("6.1 um", INSIDE)]
)
def test_the_worst_point_decides_on_a_freedom(tmp_path: Path, errors: xr.Dataset, limit: str, expected: int) -> None:
    (row,) = judge(errors, limits(tmp_path, f'freedoms = {{ EX = "{limit}" }}')).rows
    assert row.decision == expected
    assert row.value == pytest.approx(5e-6)
    assert row.guard == pytest.approx(1e-6)


def test_unknown_points_are_counted_and_an_unknown_freedom_is_not_decided(tmp_path: Path, errors: xr.Dataset) -> None:
    known, unknown = judge(errors, limits(tmp_path, 'freedoms = { EA = "20 urad", EY = "20 um" }')).rows
    assert (known.decision, known.remark) == (INSIDE, "2 of 3 points known")
    assert (unknown.decision, unknown.remark) == (OPEN, "the value is unknown")


def test_the_reference_state_proves_nothing(tmp_path: Path, errors: xr.Dataset) -> None:
    table = limits(tmp_path, 'freedoms = { EX = "9 um" }\nfigures = { "EX*" = "9 um" }')
    assert judge(errors, table).decision == INSIDE
    only = errors.assign_attrs(reference_interval=np.array([0.0, 60.0]))
    only["EX"][2] = np.nan
    found = judge(only, table)
    assert [row.decision for row in found.rows] == [OPEN, OPEN]
    assert found.rows[1].remark == "only the reference state is known, which is 0 by definition"
    exact = errors.copy(deep=True)  # without the interval: 0 ± 0 is a definition, too
    exact["EX"][1:], exact["covariance"][0] = np.nan, 0.0
    assert [row.decision for row in judge(exact, table).rows] == [OPEN, OPEN]


@pytest.mark.parametrize("rule", ["iso 14253-1", "simple", "shared risk"])
@pytest.mark.parametrize(("known", "expected"), [(0, OPEN), (1, OPEN), (4, OPEN), (5, INSIDE), (10, INSIDE)])
def test_too_few_known_points_prove_no_conformity(
    tmp_path: Path, errors: xr.Dataset, rule: str, known: int, expected: int
) -> None:
    table = limits(tmp_path, f'rule = "{rule}"\nfreedoms = {{ EX = "30 um" }}')
    many = errors.isel(time=[0] + [1] * 10).assign_coords(time=np.arange(11.0))
    many.attrs["reference_interval"] = np.zeros(2)
    many["EX"][known + 1 :] = np.nan
    (row,) = judge(many, table).rows
    assert row.decision == expected
    if 0 < known < 10:
        assert row.remark.startswith(f"{known} of 10 points known")
    # One point outside of the limits is enough.
    (row,) = judge(many, limits(tmp_path, f'rule = "{rule}"\nfreedoms = {{ EX = "1.4 um" }}')).rows
    assert row.decision == (OUTSIDE if known and rule != "shared risk" else OPEN)


def test_the_least_share_of_known_points_is_a_setting(tmp_path: Path, errors: xr.Dataset) -> None:
    text = 'least_known = {}\nfreedoms = {{ EA = "20 urad" }}'
    assert judge(errors, limits(tmp_path, text.format(0.7))).decision == OPEN
    assert judge(errors, limits(tmp_path, text.format(0.6))).decision == INSIDE


@pytest.mark.parametrize(("rule", "expected"), [("iso 14253-1", OPEN), ("shared risk", OPEN), ("simple", INSIDE)])
def test_a_value_without_uncertainty_is_decided_by_no_rule_that_needs_it(
    tmp_path: Path, errors: xr.Dataset, monkeypatch: pytest.MonkeyPatch, rule: str, expected: int
) -> None:
    monkeypatch.setattr(Foreign, "figures", lambda _self, _: [FigureOfMerit("G", 5e-6, 0.0, "m")])
    monkeypatch.setattr(plugins, "owner_of_method", {"foreign": Foreign}.get)
    errors["covariance"][:] = 0.0
    table = limits(tmp_path, f'rule = "{rule}"\nfigures = {{ G = "7 um" }}\nfreedoms = {{ EX = "7 um" }}')
    assert [row.decision for row in judge(errors, table).rows] == [expected] * 2


def test_an_empty_dataset_proves_nothing(tmp_path: Path, errors: xr.Dataset) -> None:
    (row,) = judge(errors.isel(time=slice(0)), limits(tmp_path, 'freedoms = { EX = "7 um" }')).rows
    assert (row.decision, row.remark) == (OPEN, "the value is unknown")


def test_a_limit_in_another_unit_has_no_decision(tmp_path: Path, errors: xr.Dataset) -> None:
    found = judge(errors, limits(tmp_path, 'freedoms = { EX = "20 arcsec" }'))
    assert found.decision == OPEN
    assert "the limit is in rad, the value in m" in found.lines()[1]


def test_one_sided_limits(tmp_path: Path, errors: xr.Dataset) -> None:
    lower, upper = 'freedoms = { EX = { lower = "-2 um" } }', 'freedoms = { EX = { upper = "2 um" } }'
    assert judge(errors, limits(tmp_path, lower)).decision == INSIDE
    assert judge(errors, limits(tmp_path, upper)).decision == OUTSIDE


@pytest.mark.parametrize(
    ("rule", "limit", "expected"),
    [
        ("iso 14253-1", "20 um", OPEN),
        ("iso 14253-1", "1 um", OPEN),
        ("shared risk", "20 um", OPEN),
        ("simple", "20 um", INSIDE),
    ],
)
def test_a_doubted_uncertainty_proves_nothing(
    tmp_path: Path, errors: xr.Dataset, rule: str, limit: str, expected: int
) -> None:
    stated = limits(tmp_path, f'rule = "{rule}"\nfreedoms.EX = "{limit}"')
    assert judge(errors, stated).decision in (INSIDE, OUTSIDE)
    doubted = errors.assign_attrs(doubts_uncertainty=["Two readings contradict each other."])
    found = judge(doubted, stated)
    assert found.decision == expected
    if expected == OPEN:
        assert "Two readings contradict each other" in found.rows[0].remark


def test_texts_of_rules_without_guard_band_state_no_proof(tmp_path: Path, errors: xr.Dataset) -> None:
    for rule, guard in (("simple", "simple acceptance, no guard band"), ("shared risk", "at most 0.33 of half")):
        found = judge(errors, limits(tmp_path, f'rule = "{rule}"\nfreedoms = {{ EX = "5.1 um" }}'))
        assert found.verdict == "within limits"
        assert guard in found.lines()[0]


def test_figures_that_fail_leave_the_decision_open(
    tmp_path: Path, errors: xr.Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        @staticmethod
        def figures(errors: xr.Dataset) -> Any:
            raise KeyError("radius")

    monkeypatch.setattr(plugins, "owner_of_method", {"foreign": Broken}.get)
    found = judge(errors, limits(tmp_path, 'figures = { "*" = "1 m" }\nfreedoms = { EX = "1 m" }'))
    assert found.decision == OPEN
    assert "KeyError" in found.lines()[1]


def test_without_an_applicable_limit_there_is_no_verdict(tmp_path: Path, errors: xr.Dataset, foreign: None) -> None:
    found = judge(errors, limits(tmp_path, 'figures = { other = "1 m" }'))
    assert (found.decision, found.verdict, found.lines()) == (None, "", [])


@pytest.mark.parametrize(
    ("pattern", "name", "expected"),
    [
        ("a", "a", True),
        ("a", "ab", False),
        ("a*", "ab", True),
        ("*", "", True),
        ("a*a", "a", False),
        ("a*b*c", "a-b-c", True),
        ("a*b*c", "a-c-b", False),
        ("d(Z)*[1]", "d(Z) 60 [1]", True),
        ("*a" * 50 + "b", "a" * 2000, False),
    ],
)
def test_a_star_stands_for_any_characters(pattern: str, name: str, expected: bool) -> None:
    assert matches(pattern, name) is expected


def test_a_report_starts_with_the_decision(tmp_path: Path, errors: xr.Dataset) -> None:
    table = limits(tmp_path, 'freedoms = { EX = "3 um" }')
    page = write_report(errors, tmp_path / "r.html", run={"tolerances": table.model_dump(mode="json")}).read_text()
    sentence = "The limit is exceeded (ISO 14253-1, guard band 1 U (k = 2)): EX is +5.0 ± 1.0 µm; limit ±3 µm."
    assert page.index("Tolerances: nonconformity proved") < page.index(sentence) < page.index('class="summary"')
    assert "Tolerances" not in write_report(errors, tmp_path / "s.html").read_text()
