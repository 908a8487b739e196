"""Location errors, bounds, and what a layout determines."""

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.kinematics.iso import DOF
from errormotion.methods.r_test import RTest, RTestSettings

METHOD = RTest()
SEEDS = 60
Z95 = 1.959964


def known(errors: xr.Dataset) -> list[str]:
    return [name for name in DOF if np.isfinite(errors[name].values).any()]


def placed(settings: RTestSettings, place: np.ndarray) -> xr.Dataset:
    """Return readings of noise only, of spheres at other places."""
    raw = METHOD.expected(settings).isel(sphere=slice(0, 1))
    raw = raw.drop_vars(["displacement", "sphere_position"])
    noise = np.random.default_rng(5).normal(0, settings.noise, (settings.angles, len(place), 3))
    raw["displacement"] = (("angle", "sphere", "sensor"), noise, {"units": "m"})
    raw["sphere_position"] = (("sphere", "direction"), place, {"units": "m"})
    return raw


def test_location_errors_are_covered() -> None:
    """95 % of the intervals of four location errors over 60 seeds, within three standard deviations and a bit."""
    settings = RTestSettings(angles=12)
    inside = []
    for seed in range(SEEDS):
        raw, truth = METHOD.simulate(settings, seed)
        errors = METHOD.identify(raw, settings)
        datasets.validate(errors)
        off = (errors["location_error"] - truth["location_error"]).values
        inside.append(np.abs(off) <= Z95 * np.sqrt(np.diag(errors["location_covariance"].values)))
    assert abs(np.mean(inside) - 0.95) < 3.3 * np.sqrt(0.95 * 0.05 / (4 * SEEDS))


def test_the_covariance_of_location_errors_is_that_of_their_sources() -> None:
    errors = METHOD.plan(RTestSettings())
    F, C = errors["location_influence"].values, errors["location_covariance"].values
    assert pytest.approx(C, rel=1e-9, abs=1e-24) == F.T @ F
    of_nest = F[errors["source_group"].values == "zero of the nest"]
    assert np.sqrt(np.square(of_nest).sum(axis=0)) == pytest.approx([1e-6, 1e-6, 0, 0], abs=1e-15)
    assert (errors["location_error"].values == 0).all()


def test_the_covariance_is_the_bound_with_known_constants() -> None:
    """Dense information matrix of all unknowns: 6 an angle, 3 a sphere; the datum is a projection."""
    settings = RTestSettings(
        angles=15, gain_uncertainty=0, direction_uncertainty=0, nest_uncertainty=0, position_uncertainty=0
    )
    raw = METHOD.expected(settings)
    q, p, s = (raw[name].values for name in ("angle", "sphere_position", "sensor_direction"))
    n, m = q.size, len(p)
    A = np.zeros((n, m, len(s), 6 * n + 3 * m))
    for a, (c, d) in enumerate(zip(np.cos(q), np.sin(q), strict=True)):
        R = np.array([[c, d, 0.0], [-d, c, 0.0], [0.0, 0.0, 1.0]])
        for i in range(m):
            x, y, z = R @ p[i]
            A[a, i, :, 6 * a : 6 * a + 3] = -s
            A[a, i, :, 6 * a + 3 : 6 * a + 6] = -s @ [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
            A[a, i, :, 6 * n + 3 * i : 6 * n + 3 * i + 3] = s @ R
    A = A.reshape(-1, 6 * n + 3 * m)
    C = settings.noise**2 * np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True)[: 6 * n, : 6 * n]
    D = np.zeros((n, 6, 10))
    for k, dof in enumerate((0, 1, 3, 4)):
        D[:, dof, k] = -1.0
    D[:, 2, 4] = D[:, 5, 5] = 1.0
    for k, first in ((6, 0), (8, 3)):
        D[:, first, k], D[:, first + 1, k] = np.cos(q), -np.sin(q)
        D[:, first, k + 1], D[:, first + 1, k + 1] = np.sin(q), np.cos(q)
    D = D.reshape(6 * n, 10)
    H = np.linalg.pinv(D)
    P = np.eye(6 * n) - D @ H
    whole = P @ C @ P.T
    planned = METHOD.plan(settings)
    F = planned["influence"].values.reshape(-1, 6 * n)
    found = np.diagonal(planned["covariance"].values, axis1=1, axis2=2).ravel()
    # the offsets of the spheres are part of the lever: 40 um of 120 mm
    assert found == pytest.approx(np.diag(whole), rel=2e-3)
    assert pytest.approx(whole, abs=2e-3 * np.diag(whole).max()) == F.T @ F  # places are sources of their own
    location = (H @ C @ H.T)[:4, :4]
    assert planned["location_covariance"].values == pytest.approx(location, abs=2e-3 * location.max())


def test_one_sphere_on_the_axis_determines_displacements() -> None:
    settings = RTestSettings(spheres=1)
    errors = METHOD.identify(METHOD.simulate(settings, 0)[0])
    assert known(errors) == ["EX", "EY", "EZ"]
    assert np.isfinite(errors["location_error"].values).tolist() == [True, True, False, False]
    assert errors.attrs["functional_point"].tolist() == [0.0, 0.0, settings.height]
    assert "do not determine EA, EB, EC: the only sphere is on the axis" in errors.attrs["notes"][0]
    assert any("No redundancy" in note for note in errors.attrs["notes"])


@pytest.mark.parametrize(
    ("place", "freedoms"),
    [
        ([[0, 0, 0.05], [0, 0, 0.25]], ["EX", "EY", "EZ", "EA", "EB"]),
        ([[0.1, 0, 0], [-0.1, 0.05, 0], [0, -0.1, 0]], list(DOF)),
        ([[0.1, 0, 0]], None),
        ([[0.1, 0, 0], [-0.1, 0.05, 0]], None),
        ([[0.1, 0, 0], [0, 0, 0], [-0.1, 0, 0]], None),
    ],
)
def test_what_the_spheres_do_not_determine_is_unknown(place: list, freedoms: list | None) -> None:
    raw = placed(RTestSettings(), np.array(place, dtype=float))
    if freedoms is None:
        with raises("rotary.freedoms.none"):
            METHOD.identify(raw)
    else:
        assert known(METHOD.identify(raw)) == freedoms


def test_two_sensors_are_refused() -> None:
    raw, _ = METHOD.simulate(RTestSettings(), 0)
    with raises("rotary.freedoms.none"):
        METHOD.identify(raw.isel(sensor=slice(0, 2)))


def test_missing_readings_leave_angles_unknown() -> None:
    raw, truth = METHOD.simulate(RTestSettings(), 0)
    raw["displacement"][4, 1:] = np.nan  # one sphere is left
    raw["displacement"][7, 2, 0] = np.nan  # eight readings are left
    errors = METHOD.identify(raw)
    assert np.flatnonzero(np.isnan(errors["EX"].values)).tolist() == [4]
    assert any("At 1 of 36 angles" in note for note in errors.attrs["notes"])
    off = np.stack([(errors[name] - truth[name]).values for name in DOF], axis=1)
    u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))
    assert np.nanmax(np.abs(off / u)) < 4.5


def test_the_axis_is_never_assumed() -> None:
    raw, _ = METHOD.simulate(RTestSettings(), 0)
    del raw.attrs["axis"]
    with raises("raw.axis.unknown"):
        METHOD.identify(raw)
    head = raw.assign_attrs(axis="C", chain="workpiece-X-Y-bed-Z-C-tool")
    with raises("rotary.axis.no_workpiece"):
        METHOD.identify(head)
    table = raw.assign_attrs(axis="C", chain="workpiece-C-X-Y-bed-Z-tool")
    assert METHOD.identify(table).attrs["chain"] == "workpiece-C-X-Y-bed-Z-tool"


def test_angles_increase() -> None:
    raw, _ = METHOD.simulate(RTestSettings(), 0)
    with raises("rotary.angles.form"):
        METHOD.identify(raw.isel(angle=slice(None, None, -1)))
    with raises("rotary.angles.form"):
        METHOD.identify(raw.isel(angle=slice(0, 3)))


def test_figures_state_location_errors_with_the_effect_of_each_source() -> None:
    settings = replace_axis("B")
    raw, truth = METHOD.simulate(settings, 0)
    errors = METHOD.identify(raw, settings)
    found = {each.name: each for each in METHOD.figures(errors)}
    assert list(found)[:4] == ["EX0B", "EZ0B", "EA0B", "EC0B"]
    assert {f"range of {name}B" for name in DOF} <= set(found)
    for k, name in enumerate(list(found)[:4]):
        each = found[name]
        assert abs(each.value - truth["location_error"].values[k]) < 1.5 * each.expanded_uncertainty
        assert each.influence is not None
        assert 2 * np.sqrt(sum(v**2 for v in each.influence.values())) == pytest.approx(each.expanded_uncertainty)
    assert [each.name for each in METHOD.figures(METHOD.plan(settings))] == list(found)[:4]


def replace_axis(axis: str) -> RTestSettings:
    return RTestSettings().model_copy(update={"axis": axis})


def test_a_large_offset_is_part_of_the_lever() -> None:
    """A plate 2 mm off its place: 40 urad times 2 mm are 80 nm, which would be half of the noise."""
    raw, _ = METHOD.simulate(RTestSettings(noise=1e-9, gain_uncertainty=0, direction_uncertainty=0), 0)
    nominal = raw.copy()
    nominal["sphere_position"] = raw["sphere_position"] - [2e-3, 1e-3, 0.0]
    turn = raw["angle"].values
    shift = np.stack([np.cos(turn) * 2e-3 + np.sin(turn) * 1e-3, np.cos(turn) * 1e-3 - np.sin(turn) * 2e-3,
                      np.zeros_like(turn)], axis=1)  # fmt: skip
    nominal["displacement"] = raw["displacement"] + np.einsum("ai,ki->ak", shift, raw["sensor_direction"])[:, None]
    nominal["displacement"].attrs = raw["displacement"].attrs
    errors, reference = METHOD.identify(nominal), METHOD.identify(raw)
    for name in DOF:
        size = 1e-9 if name[1] in "XYZ" else 10e-9
        assert errors[name].values == pytest.approx(reference[name].values, abs=2 * size)
    assert errors["location_error"].values == pytest.approx(reference["location_error"].values, abs=5e-9)
