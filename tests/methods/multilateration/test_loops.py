"""Loops over the targets: array operations for small networks and compiled ones for large networks agree."""

import subprocess
import sys

import numba
import numpy as np
import pytest

from errormotion import datasets
from errormotion.methods.multilateration import simulation
from errormotion.methods.multilateration.network import loops
from errormotion.methods.multilateration.network.diagnosis import outliers
from errormotion.methods.multilateration.network.model import Stations, readings
from errormotion.methods.multilateration.network.solver import solve
from errormotion.twin import VirtualMachine

NOISE = 1e-6
STATIONS = np.array([(-0.5, -0.4, -0.1), (0.5, -0.4, 0.4), (0.5, 0.4, -0.1), (-0.5, 0.4, 0.6), (0.0, -0.6, 0.3)])
SMALL = """
import sys
from errormotion import datasets
from errormotion.methods.multilateration import Multilateration

errors = Multilateration().identify(datasets.load("raw.nc"))
assert errors.sizes["target"] == 100
assert "numba" not in sys.modules, "numba was imported"
"""


def network(m, n):
    """Return displacements with noise, missing readings and one outlier of 1 mm, and the nominal targets."""
    rng = np.random.default_rng(m + n)
    u = rng.uniform(-0.2, 0.2, (m, 3)) + np.array([0.0, 0.0, 0.15])
    stations = Stations(STATIONS[:n], rng.uniform(0, 0.3, n), np.zeros(0))
    d = readings(u + rng.normal(0, 20e-6, u.shape), stations) + rng.normal(0, NOISE, (n, m))
    d[2, 20] += 1e-3
    d[0, 3] = d[1, 5] = np.nan
    d[: n - 2, 9] = np.nan  # two readings: no position
    return d, u


def compile_always(monkeypatch):
    """Use the compiled loops for networks of any size."""
    for module in (loops, outliers):
        monkeypatch.setattr(module, "COMPILED_FROM", 0)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "further"), [(4, 0), (4, 1), (5, 0), (5, 2)])
def test_both_implementations_agree_within_1e_9_of_the_uncertainty(monkeypatch, n, further):
    d, u = network(200, n)
    extra = np.random.default_rng(3).normal(0, 1.0, (further, *d.shape)) if further else None
    prior = np.full(further, 5e-6) if further else None

    def solved():
        return solve(d, u, STATIONS[:n] + 2e-3, noise=NOISE, extra=extra, extra_prior=prior)

    small = solved()
    small_response = small.response(np.full(d.shape, 1e-6))
    covariance, residual, redundancy = small.target_covariance, small.residual, small.redundancy
    compile_always(monkeypatch)
    large = solved()
    assert (large.left_out, large.undecided) == (small.left_out, small.undecided)
    assert (large.iterations, large.freedom) == (small.iterations, small.freedom)
    u_target = np.sqrt(np.einsum("tii->ti", covariance))
    assert np.isnan(large.target[9]).all()
    assert np.isnan(small.target[9]).all()
    assert np.nanmax(np.abs(large.target - small.target) / u_target) < 1e-9
    u_station = np.sqrt(np.diag(small.joint_covariance))
    off = np.abs(large.stations.vector - small.stations.vector)
    assert (off / u_station).max() < 1e-9
    np.testing.assert_allclose(large.target_covariance, covariance, rtol=1e-7, atol=1e-9 * np.nanmax(covariance))
    np.testing.assert_allclose(
        large.joint_covariance, small.joint_covariance, rtol=1e-7, atol=1e-9 * u_station.max() ** 2
    )
    np.testing.assert_allclose(large.residual, residual, atol=1e-9 * NOISE)
    np.testing.assert_allclose(large.redundancy, redundancy, atol=1e-9)
    for one, other in zip(large.response(np.full(d.shape, 1e-6)), small_response, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6 * 1e-6)


@pytest.mark.slow
def test_a_large_network_is_identical_with_any_number_of_threads():
    d, u = network(25_000, 4)
    threads, found = numba.get_num_threads(), []
    try:
        for count in {1, threads}:
            numba.set_num_threads(count)
            found.append(solve(d, u, STATIONS[:4], noise=NOISE))
    finally:
        numba.set_num_threads(threads)
    for name in ("target", "station", "target_covariance", "joint_covariance", "residual"):
        assert np.array_equal(getattr(found[0], name), getattr(found[-1], name), equal_nan=True), name


@pytest.mark.slow
def test_the_loops_for_four_stations_agree_with_the_general_ones(monkeypatch):
    # A further parameter that is held at 0 makes the general elimination do the work.
    compile_always(monkeypatch)
    d, u = network(200, 4)
    own = solve(d, u, STATIONS[:4], noise=NOISE)
    general = solve(d, u, STATIONS[:4], noise=NOISE, extra=np.ones((1, *d.shape)), extra_prior=[1e-15])
    assert np.nanmax(np.abs(own.target - general.target)) < 1e-12
    assert np.nanmax(np.abs(own.target_covariance / general.target_covariance - 1)) < 1e-5


def test_a_small_identification_compiles_nothing(tmp_path):
    datasets.save(simulation.raw(VirtualMachine("cframe", seed=1), seed=1), tmp_path / "raw.nc")
    done = subprocess.run([sys.executable, "-c", SMALL], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
