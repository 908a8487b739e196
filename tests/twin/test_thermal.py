"""Temperatures are the exact solution of the network's equation."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from errormotion.twin.kinds import KINDS
from errormotion.twin.schedule import Event
from errormotion.twin.thermal.network import Ambient, LagResponse, ThermalNetwork

AIR = Ambient(20.0, np.array([0.5, 0.1]), 2 * np.pi / np.array([86400.0, 2500.0]), np.array([0.3, 2.0]))
TIMES = np.array([0.0, 1000.0, 4000.0])
POWER = np.array([300.0, 0.0, 500.0])


def network(kind="cframe"):
    tables = KINDS[kind]
    return ThermalNetwork.of(tables.capacity, tables.links, tables.to_air, tables.heat_share)


def slope(net, temperature, air, power):
    between = net.conductance @ temperature - net.conductance.sum(axis=1) * temperature
    return (between + net.to_air * (air - temperature) + net.heat_share * power) / net.capacity


@pytest.mark.parametrize("kind", ["cframe", "gantry"])
def test_temperatures_obey_the_heat_balance(kind):
    net = network(kind)
    t = np.linspace(0, 6000, 25)
    start = net.air_response(np.zeros(1), AIR)[0]

    def power(time):
        return POWER[np.searchsorted(TIMES, time, side="right") - 1]

    def derivative(time, temperature, heat):
        return slope(net, temperature, AIR(time), heat)

    pieces, state = [start], start
    for a, b in pairwise(t):  # the switches of the heat fall on the grid
        step = solve_ivp(derivative, (a, b), state, args=(power(a),), rtol=1e-10, atol=1e-10)
        state = step.y[:, -1]
        pieces.append(state)
    exact = net.air_response(t, AIR) + net.heating(t, net.heated(TIMES, POWER))
    assert np.max(np.abs(exact - np.array(pieces))) < 1e-7  # of the stepping: 24 steps at 1e-10 of 20 to 40 degC


def test_all_the_heat_goes_into_the_air_in_the_end():
    net = network()
    rise = net.heating(np.array([1e7]), net.heated(np.zeros(1), np.array([360.0])))[0]
    assert net.to_air @ rise == pytest.approx(360.0 * net.heat_share.sum(), rel=1e-9)


def test_heat_share_is_complete():
    for kind in KINDS.values():
        assert sum(kind.heat_share.values()) == pytest.approx(1.0, abs=1e-12)


def test_a_machine_at_rest_in_still_air_has_the_airs_temperature():
    still = Ambient(21.0, np.zeros(1), np.ones(1), np.zeros(1))
    assert network().air_response(np.array([0.0, 5000.0]), still) == pytest.approx(21.0, abs=1e-12)


def test_bodies_follow_the_air_delayed_and_attenuated():
    day = Ambient(20.0, np.array([1.0]), np.array([2 * np.pi / 86400]), np.zeros(1))
    t = np.linspace(0, 86400, 500)
    swings = np.ptp(network().air_response(t, day), axis=0)
    assert np.all(swings < np.ptp(day(t)))


def test_no_temperature_rise_before_the_heat():
    net = network()
    assert not net.heating(np.array([0.0, 99.0]), net.heated(np.array([100.0]), np.array([300.0]))).any()


def test_result_does_not_depend_on_other_requested_times():
    net = network()
    t = np.linspace(0, 5000, 137)
    heated = net.heated(TIMES, POWER)
    together = net.heating(t, heated) + net.air_response(t, AIR)
    alone = [net.heating(t[i : i + 1], heated) + net.air_response(t[i : i + 1], AIR) for i in range(t.size)]
    assert np.array_equal(together, np.concatenate(alone))


def test_lag_reaches_one_minus_one_over_e_after_its_time_constant():
    z = LagResponse(np.array([1 / 50.0]), np.zeros(1), np.ones(1))(np.array([50.0]))
    assert z[0, 0] / 50 == pytest.approx(1 - np.exp(-1), rel=1e-14)


def test_a_spindle_that_stops_cools_down(machine):
    machine.start([Event(0, 15000), Event(3600, 0)])
    front = machine.temperatures([3600.0, 7200.0])[:, machine.temperature_sensors.index("spindle_front")]
    assert front[1] < front[0] - 3
