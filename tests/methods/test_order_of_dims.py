"""Raw data of every method may have their dims in any order: they are named."""

import numpy as np
import pytest

from errormotion import plugins
from errormotion.methods.spindle_drift import SpindleDrift, simulation
from errormotion.twin import Event, VirtualMachine

SUBJECTS = [subject for method in plugins.loaded("methods") for subject in getattr(method, "conformance", lambda: ())()]


def reversed_dims(raw):
    return raw.assign({name: raw.variables[name].transpose(*raw.variables[name].dims[::-1]) for name in raw.data_vars})


def assert_same(first, second):
    for name in ("EX", "EY", "EZ", "EA", "EB", "EC", "covariance"):
        np.testing.assert_allclose(first[name].values, second[name].values, rtol=1e-9, atol=1e-18, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.plugin.info.id)
def test_the_order_of_dims_does_not_change_a_result(subject):
    method, settings = subject.plugin(), subject.plugin.Settings(**subject.settings)
    raw, _ = subject.make(1)
    assert_same(method.identify(raw, settings), method.identify(reversed_dims(raw), settings))


def test_the_order_of_dims_of_stated_beams_does_not_matter():
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(0.0, 15000.0)])
    raw = simulation.raw_drift(machine, np.array([0.0, 600.0, 1800.0]), seed=1)
    method = SpindleDrift()
    assert_same(method.identify(raw), method.identify(reversed_dims(raw)))
