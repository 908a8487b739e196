"""The chapter of a test: figures, graphs and the table by target."""

import re

import numpy as np
import pytest

from errormotion.datasets.results.merit import figures_of
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.report import chapters
from errormotion.report.document import Figure, Source, Table

SETTINGS = LinearPositioningSettings(
    freedoms=("EY", "EX", "EB"), trials=200, accuracy_limit=1e-3, repeatability_limit=1e-9
)


@pytest.fixture(scope="module")
def errors():
    return LinearPositioning().identify(LinearPositioning().simulate(SETTINGS, 3)[0], SETTINGS)


@pytest.fixture(scope="module")
def part(errors):
    (found,) = chapters(Source(errors))
    return found


def blocks(part, kind):
    return [block for section in part.sections for block in section.blocks if isinstance(block, kind)]


def test_positioning_is_first_and_each_freedom_has_a_graph(part):
    assert part.key_figures[0].label == "A of EXX"
    titles = [section.title for section in part.sections]
    assert [t for t in titles if t.split()[-1] in ("EXX", "EYX", "EBX")] == [
        *("Positioning EXX", "Straightness EYX", "Angle EBX")
    ]
    assert len(blocks(part, Figure)) == 4  # and the bars of the limits


def test_the_table_by_target_contains_the_statistics_of_the_standard(part, errors):
    tables = [each for each in blocks(part, Table) if each.caption.startswith("EXX by target")]
    rows = {
        str(row[0]): [cell for table in tables for cell in table.rows[i][1:]] for i, row in enumerate(tables[0].rows)
    }
    assert sum(name.startswith("run") for name in rows) == 2 * SETTINGS.runs
    shown = np.array([float(text.replace("−", "-")) for text in rows["mean forward"]])
    stated = errors["unidirectional_mean"].sel(freedom="EXX", approach="forward").values
    np.testing.assert_allclose(shown, 1e6 * stated, atol=0.005)


def test_verdicts_follow_the_guard_band(part):
    text = " ".join(part.summary)
    assert re.search(r"A is within its limit of 1000 µm", text)
    assert re.search(r"R is above its limit of 0.001 µm", text)


def test_a_plan_has_no_chapter():
    assert chapters(Source(LinearPositioning().plan(SETTINGS))) == []


def test_figures_of_merit_are_those_of_the_standard_with_their_limits(errors):
    found = {figure.name: figure for figure in figures_of(errors)}
    A = found["A of EXX (ISO 230-2)"]
    assert pytest.approx(float(errors["A"])) == A.value
    assert pytest.approx(2.0 * float(errors["A_u"]) + abs(float(errors["A_bias"]))) == A.expanded_uncertainty
    assert A.limit == pytest.approx(1e-3)
    assert found["B of EBX (ISO 230-2)"].unit == "rad"
