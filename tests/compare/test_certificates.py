"""Common certificates are fully correlated: measurements with one bar and thermometer, and with two of each."""

import json

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import plugins
from errormotion.compare import compare
from errormotion.compare.text import verdict
from errormotion.datasets import certificates
from errormotion.methods.multilateration import simulation as tracking
from errormotion.methods.spindle_drift import simulation as drifting
from errormotion.twin import Event, VirtualMachine

START = "2026-03-02T07:00:00+00:00"
U_RADIUS = 20e-6
"""Standard uncertainty of the bar's radius, m; large, so that its share is seen."""


def identified(method, raw, **settings):
    cls = plugins.get("methods", method)
    return cls().identify(raw, cls.Settings.model_validate(settings))


@pytest.fixture(scope="module")
def record():
    """Return a raw record with a bar of this certificate."""
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(120.0, 12000.0, None)])
    times = np.arange(0.25, 3600.0, 20.0)

    def make(seed, bar):
        raw = drifting.raw_drift(machine, times, seed=seed, beams="true", warm_up=False, radius_error=False)
        return raw.assign_attrs(start=START, certificates=json.dumps({"bar": bar}))

    return make


def drift(raw):
    point = (0.0, 0.0, 0.0)
    return identified("spindle_drift", raw, average=40.0, functional_point=point, bar_radius_uncertainty=U_RADIUS)


def test_one_bar_in_two_runs_is_fully_correlated(record):
    first, same, other = (drift(record(seed, bar)) for seed, bar in ((1, "K-7"), (2, "K-7"), (2, "K-8")))
    shared = compare({"first": first, "second": same}, causes=False)
    apart = compare({"first": first, "second": other}, causes=False)
    assert json.loads(shared.attrs["shared_sources"]) == ["certificate K-7: bar, radius"]
    assert json.loads(apart.attrs["shared_sources"]) == []
    assert "Treated as fully correlated between datasets: certificate K-7: bar, radius." in verdict(shared)
    assert not any("one draw" in line for line in verdict(apart))
    one, both = (np.diagonal(each["difference_covariance"].values[0, -1]) for each in (shared, apart))
    assert (both > one).any()
    k = [str(name) for name in first["source"].values].index("bar radius")
    effect = np.array([first["influence"].values[k, -1, j] for j in range(5)])
    np.testing.assert_allclose(both - one, 2 * effect**2, rtol=1e-2, atol=1e-4 * both.max())


def test_one_thermometer_in_two_volumes_is_fully_correlated():
    machine = VirtualMachine("cframe", seed=3)
    position = tracking.target_grid(machine, (3, 3, 2))

    def volume(seed, thermometer):
        raw = tracking.raw(machine, position, seed=seed)
        raw = raw.assign_attrs(start=START, certificates=json.dumps({"thermometer": thermometer}))
        one = xr.ones_like(raw["displacement"].transpose("station", "target")).drop_attrs()
        air = {"air_temperature": 20.0 * one, "air_pressure": 101325.0 * one, "relative_humidity": 0.5 * one}
        return identified("multilateration", raw.assign(air), parametric=False)

    first, same, other = (volume(seed, number) for seed, number in ((1, "T-1"), (2, "T-1"), (2, "T-2")))
    shared, apart = (compare({"a": first, "b": each}, causes=False) for each in (same, other))
    assert json.loads(shared.attrs["shared_sources"]) == ["certificate T-1: thermometer, offset"]
    assert json.loads(shared.attrs["shared_names"]) == ["air temperature"]
    assert json.loads(apart.attrs["shared_sources"]) == []
    one, both = (np.trace(each["difference_covariance"].values[0], axis1=1, axis2=2) for each in (shared, apart))
    assert (both > one).all()


@pytest.mark.parametrize("text", ["[", "[]", '{"bear": "K-7"}', '{"bar": ""}', '{"bar": 7}', "[" * 5000, 7])
def test_invalid_certificates_are_an_error(text):
    with raises("certificate.form"):
        certificates.certified({"certificates": text}, {"bar radius": ("bar", "radius")})


def identities(ds):
    return {str(name): str(key) for name, key in zip(ds["source"].values, ds["source_id"].values, strict=True) if key}


def test_each_source_that_can_be_certified_has_its_identity():
    stated = {"certificates": json.dumps(dict.fromkeys(certificates.ITEMS, "N-1")), "start": START}
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(120.0, 12000.0, None)])
    times = np.arange(0.25, 3600.0, 20.0)
    raw = drifting.raw_drift(machine, times, seed=1, beams="true", warm_up=False, expansion=True).assign_attrs(stated)
    raw = raw.assign(frame_expansion=(("channel", "direction"), np.full((5, 3), 2e-6), {"units": "m/K"}))
    settings = {"average": 40.0, "bar_radius_uncertainty": U_RADIUS, "frame_temperature": str(raw["sensor"].values[0])}
    found = identities(identified("spindle_drift", raw, **settings))
    assert found["bar radius"] == "certificate N-1: bar, radius"
    assert found["frame expansion"] == "certificate N-1: frame, coefficient of expansion"

    raw = tracking.raw(machine, tracking.target_grid(machine, (3, 3, 2)), seed=1).assign_attrs(stated)
    warm = {"temperature": 24.0, "coefficient_uncertainty": 1e-6, "temperature_uncertainty": 0.2}
    volume = identified(
        "multilateration", raw, parametric=False, scale_uncertainty=1e-6, expansion={"coefficient": 11e-6, **warm}
    )
    found = identities(volume)
    assert found["tracker scale"] == "certificate N-1: tracker, scale"
    assert found["coefficient of expansion"] == "certificate N-1: scales, coefficient of expansion"
    assert found["scale temperature X"] == "certificate N-1: scale thermometer, offset at X"

    (beam,) = plugins.get("methods", "beam_direction")().conformance()
    raw, _ = beam.make(0)
    settings = {**beam.settings, "layout": {**beam.settings["layout"], "scale_uncertainty": 1e-3}}
    found = identities(identified("beam_direction", raw.assign_attrs(stated), **settings))
    assert found == {"scale of the sensor": "certificate N-1: sensor, gain"}
