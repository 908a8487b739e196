"""Causes at the functional point of a dataset, the rule that names one, and the sentences about it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from errormotion import datasets
from errormotion.compare import compare
from errormotion.compare.point_errors import PointErrors, Stored
from errormotion.compare.report import part
from errormotion.compare.text import cause_text, verdict
from errormotion.datasets import DOF
from errormotion.kinematics import twists

T = np.arange(0.0, 7201.0, 240.0)
NOISE = np.array([1e-7] * 3 + [5e-7] * 3)
SIZE = np.array([20e-6, 25e-6, 40e-6, 60e-6, 50e-6, 40e-6])
TAU = np.array([1500.0, 2600.0, 2000.0, 1800.0, 2400.0, 3000.0])
HERE, THERE = np.array([0.1, -0.05, 0.2]), np.array([-0.15, 0.1, -0.1])


def drift(t):
    t = np.asarray(t)[:, None]
    return SIZE * (1 - np.exp(-t / TAU)) + 0.2 * SIZE * np.sin(t / 1700)


def made(name, rng, *, point=HERE, change=None, noise=NOISE, errors=None, added=0.0, dim="time"):
    """Return errors of one motion at a functional point; ``change`` (6, 6) is a mistake in what is stated there."""
    A = np.eye(6) if change is None else np.asarray(change)
    E = twists.move(drift(T) if errors is None else errors, point) + added + noise * rng.normal(size=(T.size, 6))
    C = np.tile(A @ np.diag(noise**2) @ A.T, (T.size, 1, 1))
    place = {name: ("target", np.linspace(0, 0.3, T.size) * k) for k, name in enumerate("xyz", 1)}
    return datasets.build_errors(
        E @ A.T, C, dims=(dim,), coords={"time": T} if dim == "time" else place, component="tool", machine="M",
        frame="machine", functional_point=point, reference="cold", method=name, method_version="1", provenance={},
        start="2026-03-01T08:00:00+00:00",
    )  # fmt: skip


def factor(names, value):
    return np.diag(np.where(np.isin(DOF, names), value, 1.0))


def swapped(i, j):
    A = np.eye(6)
    A[[i, j]] = A[[j, i]]
    return A


PLANTED = {
    "sign of EB": factor(("EB",), -1.0),
    "sign of EC": factor(("EC",), -1.0),
    "scale of EA": factor(("EA",), 1.3),
    "scale of the rotations": factor(DOF[3:], 3.0),
    "scale of the displacements": factor(DOF[:3], 1.2),
    "EA and EB exchanged": swapped(3, 4),
    "unit of 'b': urad taken as arcsec": factor(DOF[3:], np.pi / 180 / 3600 * 1e6),
    "unit of 'b': um taken as mm, or mm as um": factor(DOF[:3], 1e-3),
    "unit of 'b': mm taken as inches": factor(DOF[:3], 1 / 25.4),
}


@pytest.mark.parametrize("dim", ["time", "target"])
@pytest.mark.parametrize("name", PLANTED)
def test_a_mistake_is_found_at_the_functional_point_of_its_dataset(name, dim):
    rng, first = np.random.default_rng(1), 0
    for _ in range(3):
        sets = {"a": made("a", rng, dim=dim), "b": made("b", rng, point=THERE, change=PLANTED[name], dim=dim)}
        found = compare(sets)
        right = {name, f"{name} of 'b'", f"{name} in 'b'"}
        cause, alike = found["cause"].values[0, 0], found["alike"].values[0, 0].split("; ")
        first += cause in right
        assert right & {cause, *alike}
        assert found["cause_p"].values[0, 0] > 1e-4
    assert first >= 2  # a free scale fits as well as a unit by chance


def test_the_size_of_a_scale_at_its_own_point_holds_its_uncertainty():
    rng, scores = np.random.default_rng(2), []
    for _ in range(12):
        sets = {"a": made("a", rng), "b": made("b", rng, point=THERE, change=factor(("EA",), 1.5))}
        first = compare(sets).isel(pair=0, rank=0)
        assert first["cause"].item() == "scale of EA of 'b'"
        scores.append((first["size"].values[0] - 0.5) / first["size_u"].values[0])
    assert 0.3 < np.sqrt(np.mean(np.square(scores))) < 2.0
    assert np.abs(scores).max() < 4


def test_a_functional_point_far_away_is_found_with_the_noise_of_the_rotations():
    """A lever of 2 m makes the noise of the rotations ten times that of the displacements."""
    rng = np.random.default_rng(3)
    wrong = made("b", rng, point=(0.0, 0.0, 2.0)).assign_attrs(functional_point=np.zeros(3))
    found = compare({"a": made("a", rng, point=np.zeros(3)), "b": wrong})
    first = found.isel(pair=0, rank=0)
    assert first["cause"].item() == "functional point"
    assert first["cause_p"].item() > 1e-3
    assert abs(abs(first["size"].values[0]) - 2.0) < 4 * first["size_u"].values[0]


@pytest.mark.parametrize(("freedom", "rate"), [("EX", 1e-6), ("EZ", -2e-6), ("EB", 2e-5)])
def test_a_sensor_that_drifts_is_a_cause_with_its_rate(freedom, rate):
    rng = np.random.default_rng(4)
    k = DOF.index(freedom)
    added = np.multiply.outer(T / 3600, rate * np.eye(6)[k])
    found = compare({"a": made("a", rng), "b": made("b", rng, added=added)})
    first = found.isel(pair=0, rank=0)
    assert first["cause"].item() == "drift of a sensor (linear in time)"
    assert 3600 * first["size"].values[0] == pytest.approx(-rate, rel=0.2)  # first minus second dataset
    unit = "um/h" if k < 3 else "arcsec/h"
    text = cause_text(found, 0, 0).size
    assert text.startswith(f"{freedom} ")
    assert text.endswith(unit)


def test_a_sensor_beside_the_functional_point_drifts_in_several_freedoms():
    """A sensor along X, 0.2 m above the functional point, changes EX and EB."""
    rng = np.random.default_rng(5)
    added = np.multiply.outer(T / 3600, [0.5e-6, 0, 0, 0, 2.5e-6, 0])
    found = compare({"a": made("a", rng), "b": made("b", rng, added=added)})
    assert found["cause"].values[0, 0] == "drift of a sensor (linear in time)"


def test_a_freedom_that_is_zero_has_no_wrong_sign():
    """Turned noise explains a small difference as well as noise does; before, it was named in most alarms."""
    rng, alarms, named = np.random.default_rng(6), 0, []
    flat = drift(T) * [0, 0, 1, 0, 0, 0]
    for _ in range(150):
        sets = {each: made(each, rng, point=np.zeros(3), errors=flat) for each in "ab"}
        found = compare(sets)
        if found["p"].item() < 0.05:
            alarms += 1
            named += [name] if (name := found["cause"].values[0, 0]) else []
    assert alarms >= 3
    assert len(named) <= alarms / 2


def test_an_alarm_without_a_cause_says_that_none_is_known():
    rng = np.random.default_rng(24)  # p is 0.02
    found = compare({each: made(each, rng) for each in "ab"})
    assert found["p"].item() < 0.05
    assert not found["cause"].values[0, 0]
    assert "a - b: none of the known causes explains the difference better than chance." in verdict(found)
    assert found.attrs["searched"].tolist() == [1]


def stated(found, **values):
    """Return a comparison with another first cause."""
    found = found.copy(deep=True)
    for name, value in values.items():
        array = found[name].values.astype(object) if isinstance(value, str) else found[name].values
        array[(0, 0, *([0] if name.startswith("size") else []))] = value
        found[name] = (found[name].dims, array)
    return found


@pytest.fixture(scope="module")
def contradiction():
    rng = np.random.default_rng(8)
    return compare({"a": made("a", rng), "b": made("b", rng, point=THERE, change=factor(("EB",), -1.0))})


@pytest.mark.parametrize("p", [1e-9, 0.3])
def test_a_cause_without_a_size_is_named_without_a_gap_or_unit(contradiction, p):
    text = " ".join(verdict(stated(contradiction, cause_p=p)))
    assert "sign of EB of 'b'." in text
    for wrong in (" .", " ,", "  ", "nan", "()", " ;"):
        assert wrong not in text


def test_an_unknown_size_is_not_printed(contradiction):
    one = stated(contradiction, size_name="X (m)", size=float("nan"), size_u=float("nan"))
    assert cause_text(one, 0, 0).size == ""
    assert cause_text(stated(contradiction, size_name="X (m)", size=0.02, size_u=float("nan")), 0, 0).size == "X 20 mm"


def test_points_without_a_known_value_are_unknown_and_not_0(contradiction):
    from errormotion.cli.commands.results.compare import text

    found = contradiction.assign(en=np.nan * contradiction["en"], p=("pair", [np.nan]))
    row = next(line for line in text(found).splitlines() if line.startswith("a - b  "))
    assert row.split()[3:5] == ["unknown", "unknown"]
    shown = part(found, "k")
    cells = [figure.value.text for figure in shown.key_figures if figure.label == "Largest |En|"]
    assert cells == ["unknown"]


@pytest.mark.parametrize("unknown", [(), (1,), (1, 5)])
def test_one_matrix_for_all_points_is_the_same_as_one_at_each_point(unknown):
    """An unknown rotation is 0 at a lever, and makes the freedoms unknown that it replaces."""
    each = PointErrors.of(made("a", np.random.default_rng(9)))
    each.value[4, list(unknown)] = each.own[4, list(unknown)] = each.own[4, :, list(unknown)] = np.nan
    turn = Rotation.from_rotvec([0.1, -0.2, 0.05])
    for A in (factor(("EB",), -1.0), swapped(1, 2), twists.adjoint(shift=[0.1, 0.2, -0.3]), twists.adjoint(turn)):
        one, other = each.times(A), each.times(np.broadcast_to(A, (T.size, 6, 6)))
        for name in ("value", "own", "influence"):
            found, expected = getattr(one, name), getattr(other, name)
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15 * np.nanmax(np.abs(expected), initial=0))
        moved = Stored(each, np.array([0.1, 0.0, -0.2]))
        np.testing.assert_array_equal(moved.values(A), moved.changed(A).value)


def test_causes_that_the_data_cannot_distinguish_have_no_rank_in_the_sentence():
    found = compare({"a": made("a", rng := np.random.default_rng(1)), "b": made("b", rng, change=factor(("EA",), 1.3))})
    found = stated(found, cause="scale of EA", alike="drift; sign of EB")
    found["cause_p"].values[0, 0] = 0.5
    told = [line for line in verdict(found) if line.startswith("a - b: possible causes")]
    assert len(told) == 1
    assert told[0].startswith("a - b: possible causes, which these data cannot distinguish: scale of EA")
    assert told[0].endswith("; drift; sign of EB.")
    assert "most likely" not in " ".join(verdict(found))
    found = stated(found, alike="")
    assert any(line.startswith("a - b: most likely cause: scale of EA") for line in verdict(found))
