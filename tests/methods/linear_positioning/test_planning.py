"""Targets, cycles, motions, program and expected uncertainty."""

import re

import numpy as np
import pytest
from scipy import stats

from errormotion.errors import MethodError
from errormotion.kinematics.description import MachineDescription
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.planning import motions, targets
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth

METHOD = LinearPositioning()


@pytest.mark.parametrize(("length", "count"), [(0.5, 11), (2.0, 11), (1.99, 11), (3.0, 13), (10.0, 41)])
def test_as_many_targets_as_the_standard_requires(length, count):
    assert targets.standard_count(length) == count


def test_targets_have_a_random_part_and_stay_within_the_travel():
    for seed in range(50):
        settings = LinearPositioningSettings(travel=(0.1, 0.6), seed=seed)
        P = targets.positions(settings)
        assert P[0] >= 0.1
        assert P[-1] <= 0.6
        assert (np.diff(P) > 0).all()
        assert np.ptp(np.diff(P)) > 1e-3  # not periodic
    again = targets.positions(settings)
    np.testing.assert_array_equal(P, again)


@pytest.mark.parametrize("cycle", ["linear", "pendulum"])
def test_every_target_is_approached_over_the_overrun(cycle):
    settings = LinearPositioningSettings(cycle=cycle, runs=3, count=5, targets=())
    P, visits, position = targets.positions(settings), [], None
    for approach in targets.sequence(settings):
        position = approach.before if approach.before is not None else position
        distance = approach.position - position
        assert (distance > 0) == (approach.direction == 0)
        assert abs(distance) >= settings.overrun - 1e-12
        assert approach.position == P[approach.target]
        position = approach.position
        visits.append((approach.run, approach.direction, approach.target))
    assert sorted(visits) == [(run, way, i) for run in range(3) for way in range(2) for i in range(5)]


def test_motions_are_those_of_the_program_within_the_limits():
    settings = LinearPositioningSettings(axis="Y", travel=(0.0, 0.4), limits=(-0.01, 0.41), start=(0.1, 0.0, 0.2))
    steps = METHOD.motions(settings)
    places = [step.place for step in steps if step.place is not None]
    assert {place[0] for place in places} == {0.1}
    assert {place[2] for place in places} == {0.2}
    y = np.array([place[1] for place in places])
    assert y.min() >= -0.01
    assert y.max() <= 0.41
    (text,) = METHOD.programs(settings).values()
    moved = [float(found) for found in re.findall(r"^G[01] .*?Y(-?[0-9.]+)", text, flags=re.MULTILINE)]
    np.testing.assert_allclose(moved, 1e3 * y, atol=1e-9 + 5e-4)
    assert text.count("G4 P4.000") == sum(step.what == "rest" for step in steps) == 2 * 5 * 11


def test_a_test_beyond_the_limits_is_refused():
    settings = LinearPositioningSettings(travel=(0.0, 0.4), limits=(0.0, 0.4), overrun=0.1)
    with pytest.raises(MethodError, match=r"expected X from 0\.000 to 400\.000 mm; .*, with an overrun of 100 mm"):
        motions.steps(settings)
    machine = MachineDescription("C-frame", "workpiece-X-Y-bed-Z-spindle-tool", dict.fromkeys("XYZ", (0.0, 0.3)))
    assert "travel" in METHOD.check_machine(settings, machine)
    assert METHOD.check_machine(LinearPositioningSettings(travel=(0.1, 0.2)), machine) == {}


def test_the_plan_states_the_uncertainty_of_a_simulated_test():
    """With the scatter and drift assumed by the plan, the mean stated uncertainty is that of the plan."""
    stated = {"scatter": 0.5e-6, "drift": np.sqrt(12.0) * 0.6e-6}
    settings = LinearPositioningSettings(runs=12, trials=200, uncertainty=stated)
    plan = METHOD.plan(settings)
    groups = ["drift from run to run", "independent"]
    planned = plan.em.budget().sel(group=groups, dof="EX").isel(position=5).values
    # half of the variance of a run of one approach is common to both
    assert planned == pytest.approx([0.6e-6 / np.sqrt(24), 0.5e-6 / np.sqrt(24)])
    behaviour = Behaviour(0.5e-6, 0.6e-6 / np.sqrt(2.0), 0.0, 0.6e-6 / np.sqrt(2.0))
    free, measured = LinearPositioningSettings(runs=12, trials=200), []
    for seed in range(20):
        errors = METHOD.identify(raw_and_truth(free, seed, behaviour)[0], free)
        measured.append(errors.em.budget().sel(group=groups, dof="EX").isel(position=5).values ** 2)
    # a variance with 11 degrees of freedom is known to 43 %, its mean over 20 tests to 10 %
    student = np.array([stats.t.ppf(0.975, 11) / stats.norm.ppf(0.975), 1.0])
    assert np.sqrt(np.mean(measured, axis=0)) == pytest.approx(planned * student, rel=0.2)


def test_duplicate_targets_are_refused():
    with pytest.raises(ValueError, match="three or more different positions"):
        LinearPositioningSettings(targets=(0.1, 0.1, 0.2))
