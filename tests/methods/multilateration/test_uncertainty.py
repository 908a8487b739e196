"""Results of many targets, calculated in blocks, agree with those in one piece."""

import numpy as np
import pytest

from errormotion import datasets
from errormotion.errors import DatasetError
from errormotion.methods.multilateration import Multilateration, Settings, simulation
from errormotion.methods.multilateration.identification import result
from errormotion.methods.multilateration.identification.uncertainty import Scatter
from errormotion.twin import VirtualMachine


@pytest.fixture(scope="module")
def raw():
    machine = VirtualMachine("cframe", seed=3)
    q = simulation.target_grid(machine, (4, 4, 3))
    return simulation.raw(machine, np.concatenate([q, q[::4]]), seed=1, missing=0.04, repeatability=1e-6)


def test_the_block_size_has_no_effect(raw, monkeypatch):
    settings = Settings(scale_uncertainty="1 um/m", expansion={"coefficient": 11.5e-6, "temperature": 23.0})
    whole = Multilateration().identify(raw, settings)
    monkeypatch.setattr(result, "BLOCK", 11)
    pieces = Multilateration().identify(raw, settings)
    datasets.validate(pieces)
    assert set(pieces.variables) == set(whole.variables)
    assert pieces.attrs.keys() == whole.attrs.keys()
    for name, variable in whole.variables.items():
        assert pieces[name].dims == variable.dims
        if variable.dtype.kind == "f":
            # Sums in another order: rounding.
            size = np.nanmax(np.abs(variable.values), initial=0.0)
            np.testing.assert_allclose(pieces[name].values, variable.values, rtol=1e-6, atol=1e-9 * size)
        else:
            assert (pieces[name].values == variable.values).all()


def test_violations_are_found_in_any_block(monkeypatch):
    monkeypatch.setattr(result, "BLOCK", 10)
    covariance = np.tile(np.eye(6), (25, 1, 1)) * 1e-12
    covariance[22, 1, 1] = -1e-12
    with pytest.raises(DatasetError, match="variances of 0 or more"):
        result.build(
            np.zeros((25, 6)), covariance, np.zeros((1, 25, 6)), {}, {}, component="tool", machine="m",
            frame="machine", functional_point=[0, 0, 0], reference="r", method="multilateration", method_version="1",
            provenance={}, sources=["a"], source_groups=["a"],
        )  # fmt: skip


def test_shares_of_the_scatter_are_those_of_the_variance():
    scatter = Scatter(0.3e-6, 0.4e-6)
    assert scatter.total == pytest.approx(0.5e-6)
    assert scatter.shares == {"stations": pytest.approx(0.36), "repeatability": pytest.approx(0.64)}
    assert Scatter(1e-6).shares == {"stations": 1.0}
