"""When a campaign does what."""

import json
from itertools import pairwise

import pytest
from coded import raises

from errormotion.errors import MethodError
from errormotion.instruments.simulators.virtual_world.nc_program import interpret
from errormotion.methods.crossbeam_scan.acquisition.programs import measuring_pass
from errormotion.methods.crossbeam_scan.acquisition.schedule import PROGRAM_INTERVAL, schedule
from errormotion.methods.crossbeam_scan.settings import MINUTE, CrossbeamScanSettings

TRAVEL = {"X": (0.0, 1.0), "Y": (0.0, 3.0), "Z": (0.0, 1.0)}


@pytest.fixture
def settings():
    """Eight artefacts, warm-up times as published."""
    return CrossbeamScanSettings(positions=tuple(0.35 + 0.2 * k for k in range(8)))


def test_every_pass_starts_at_its_warm_up_time_with_moves_between(settings):
    plan = schedule(settings)
    assert plan.cold == 2
    assert [plan.of_cycle(2 + k).start for k in range(9)] == list(settings.warm_up)
    gaps = [second.start - first.end for first, second in pairwise(plan.items)]
    # a rest that is too short for a stroke of a millimetre there and back is not moved
    assert min(gaps) > PROGRAM_INTERVAL - 1e-6
    assert max(gaps) < PROGRAM_INTERVAL + 0.05


def test_cold_passes_come_before_the_warm_up(settings):
    plan = schedule(settings)
    cold = [plan.of_cycle(cycle) for cycle in range(2)]
    assert [plan.before(cycle) for cycle in range(2)] == [None, None]
    assert cold[0].end < cold[1].start < cold[1].end < 0
    assert plan.before(2).program == "warm_up_1.nc"
    assert plan.before(2).start == 0


def test_duration_is_the_last_warm_up_time_and_the_passes_at_both_ends(settings):
    plan = schedule(settings)
    one = plan.of_cycle(0).seconds
    way = (1.4 + 0.056 + 2 * 0.005) / settings.measuring_feed  # back to where the pass begins
    assert plan.seconds == pytest.approx(180 * MINUTE + 3 * one + way + 2 * PROGRAM_INTERVAL)


def test_predicted_durations_are_those_of_a_control_that_moves_with_constant_feed(settings):
    plan = schedule(settings)
    low, _ = measuring_pass(settings).reach()
    place = low
    for item in plan.items:
        path = interpret(plan.programs[item.program].text(), (0.0, place, 0.0), TRAVEL, rapid=1.0)
        # places are written to a micrometre: 0.5 um a move at 60 mm/s
        assert path.duration == pytest.approx(item.seconds, abs=1e-3)
        place = float(path.places[-1][1])


def test_warm_up_times_without_time_for_a_pass_between_them_are_refused(settings):
    close = settings.model_copy(update={"warm_up": (7 * MINUTE, 8 * MINUTE)})
    with raises("scan.warm_up.too_short"):
        schedule(close)


def test_campaign_without_artefacts_states_what_is_missing():
    with pytest.raises(MethodError, match="set 'positions'"):
        schedule(CrossbeamScanSettings())


def test_a_campaign_may_be_cold_passes_only(settings):
    plan = schedule(settings.model_copy(update={"warm_up": ()}))
    assert [item.program for item in plan.items] == ["pass.nc", "pass.nc"]


def test_schedule_is_stored_in_the_dataset_as_json(settings):
    items = json.loads(schedule(settings).to_json())
    assert items[3] == {"program": "pass.nc", "start": 420.0, "seconds": pytest.approx(60.64, abs=0.01), "cycle": 2}
