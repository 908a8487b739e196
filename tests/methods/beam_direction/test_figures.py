"""Figures of merit of a beam: SI values with U (k = 2)."""

import math

import numpy as np
import pytest

from errormotion.methods.beam_direction import BeamDirection, BeamDirectionSettings, simulation
from errormotion.twin import VirtualMachine


@pytest.fixture(scope="module")
def beam():
    planes = [(math.radians(20.0), math.radians(b)) for b in (0, 90, 180, 270)]
    machine = VirtualMachine("cframe", seed=3)
    return BeamDirection().identify(simulation.raw(machine, planes, seed=3, inclination_error=False, check_bar=True))


def test_a_beam_states_its_errors_with_their_expanded_uncertainty(beam):
    figures = BeamDirection.figures(beam)[:6]
    assert [figure.name[:2] for figure in figures] == ["EX", "EY", "EZ", "EA", "EB", "EC"]
    assert [figure.unit for figure in figures] == ["m"] * 3 + ["rad"] * 3
    for k, figure in enumerate(figures):
        assert figure.value == float(beam[figure.name[:2]][0])
        u = math.sqrt(float(beam["covariance"][0, k, k]))
        assert figure.expanded_uncertainty == pytest.approx(2 * u, rel=1e-12)


def test_undetermined_freedoms_have_no_figure(beam):
    unknown = beam.assign(EX=np.nan * beam["EX"])
    assert not any(figure.name.startswith("EX") for figure in BeamDirection.figures(unknown))


def test_a_check_bar_states_its_radius_and_residual(beam):
    radius, residual = BeamDirection.figures(beam)[-2:]
    assert (radius.value, radius.expanded_uncertainty) == (
        float(beam["bar_radius_fitted"]),
        2 * float(beam["bar_radius_u"]),
    )
    assert math.isnan(residual.expanded_uncertainty)


@pytest.mark.usefixtures("no_search")
def test_a_plan_has_no_figures():
    assert BeamDirection.figures(BeamDirection().plan(BeamDirectionSettings())) == []
