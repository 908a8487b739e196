"""Targets and stations from displacements: exact, optimal with noise, and with a correct uncertainty."""

import numpy as np
import pytest
from coded import raises
from scipy.optimize import least_squares
from scipy.stats import chi2, norm

from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.model import Shared, Sources
from errormotion.methods.multilateration.networks import bound, solve, station_covariance
from errormotion.methods.multilateration.start import Stations, directions, readings

# Around a cube of 100 mm, at distances like its size: the linear regime at 1 um.
NEAR = np.array(
    [
        [-0.15, -0.15, -0.1],
        [0.16, -0.13, 0.02],
        [0.0, 0.17, -0.05],
        [0.02, 0.01, 0.2],
        [0.18, 0.1, 0.1],
        [-0.1, 0.1, 0.2],
    ]
)
NOISE = 1e-6


def nominal_targets(m, seed=5):
    return np.random.default_rng(seed).uniform(-0.05, 0.05, (m, 3))


def measured(target, station, noise=0.0, seed=0, dead_path=0.3):
    L = dead_path + 0.01 * np.arange(len(station))
    d = readings(target, Stations(station, L))
    return d + np.random.default_rng([7, seed]).normal(0.0, 1.0, d.shape) * noise


def jacobian(target, stations, known):
    """Return the derivatives of the known readings, by target, by (u_1, ..., U_1, L_1, ...)."""
    n, m = known.shape
    e, J = directions(target, stations.position), np.zeros((m, n, 3 * m + 4 * n))
    for i in range(m):
        for j in range(n):
            J[i, j, 3 * i : 3 * i + 3] = e[j, i]
            J[i, j, 3 * m + 4 * j : 3 * m + 4 * j + 4] = [*-e[j, i], -1.0]
    return J[known.T]


def joint(network):
    """Return the covariance of all targets, (3 m, 3 m)."""
    errors = network.solved.relative.errors
    m, F = len(errors.value), errors.influence.reshape(len(errors.sources), -1)
    C = F.T @ F
    C.reshape(m, 3, m, 3)[np.arange(m), :, np.arange(m)] += errors.own
    return C


def dense_covariance(target, station, weight, in_datum):
    """Return the covariance of (targets, stations) with inner constraints on targets, from the full bordered system."""
    m, n = len(target), len(station)
    known = weight > 0
    stations = Stations(station, np.zeros(n))
    J = jacobian(target, stations, known) * weight.T[known.T][:, None]
    centre = target.mean(axis=0)
    size = np.sqrt(np.mean((target - centre) ** 2))
    G = np.zeros((3 * m + 4 * n, 6))
    G[: 3 * m] = rigid_motions(target, centre).reshape(3 * m, 6) / [1, 1, 1, size, size, size]
    G[: 3 * m][np.repeat(~in_datum, 3)] = 0.0
    # Scaled to one, so that the bordered matrix loses no digits.
    s = np.linalg.norm(J)
    N = np.block([[J.T @ J / s**2, G], [G.T, np.zeros((6, 6))]])
    return np.linalg.inv(N)[: 3 * m + 4 * n, : 3 * m + 4 * n] / s**2


@pytest.mark.parametrize("n", [4, 5, 6])
def test_exact_distances_determine_exact_positions(n):
    u = nominal_targets(25)
    shifted = u + np.random.default_rng(1).normal(0, 20e-6, u.shape)
    network = solve(measured(shifted, NEAR[:n]), u, NEAR[:n] + 5e-3, noise=NOISE)
    # The network is only known but for a motion of the whole: distances between targets are what must agree.
    between = np.linalg.norm(network.target[:, None] - network.target, axis=-1)
    assert np.abs(between - np.linalg.norm(shifted[:, None] - shifted, axis=-1)).max() < 1e-12


@pytest.mark.parametrize("n", [4, 5])
def test_agrees_with_a_dense_least_squares_solver(n):
    u, U = nominal_targets(15), NEAR[:n]
    d = measured(u, U, NOISE)
    network = solve(d, u, U, noise=NOISE, robust=False)
    stations = Stations(U, np.zeros(n))
    known = np.ones(d.shape, dtype=bool)

    def unpack(x):
        s = x[45:].reshape(n, 4)
        return x[:45].reshape(15, 3), Stations(s[:, :3], s[:, 3])

    def off(x):
        return (readings(*unpack(x)) - d).T.ravel() / NOISE

    start = np.concatenate([network.target.ravel() + 1e-6, np.column_stack([U, network.stations.dead_path]).ravel()])
    found = least_squares(
        off,
        start,
        lambda x: jacobian(*unpack(x), known) / NOISE,
        x_scale=0.1,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    target, _ = unpack(found.x)
    between = np.linalg.norm(network.target[:, None] - network.target, axis=-1)
    assert np.abs(between - np.linalg.norm(target[:, None] - target, axis=-1)).max() < 1e-11
    assert network.sigma0 == pytest.approx(np.sqrt(2 * found.cost / network.freedom), rel=1e-9)
    assert network.freedom == 15 * (n - 3) - (4 * n - 6)
    assert stations.position.shape == network.stations.position.shape


def test_a_free_network_is_fitted_to_the_nominal_targets():
    u = nominal_targets(40)
    true = u + np.random.default_rng(1).normal(0, 20e-6, u.shape)
    # Where the whole stands and how it is turned cannot be seen in distances.
    c, s = np.cos(0.3), np.sin(0.3)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    d = measured(true @ R.T + 0.7, NEAR[:4] @ R.T + 0.7, NOISE)
    network = solve(d, u, noise=NOISE)
    error = network.target - u
    assert np.abs(error.mean(axis=0)).max() < 1e-14
    # The best rotation is the one that no infinitesimal one improves.
    assert np.abs(np.cross(u - u.mean(axis=0), error).mean(axis=0)).max() < 1e-14
    assert np.sqrt(np.mean((error - (true - u)) ** 2)) < 10e-6


@pytest.mark.parametrize(("n", "missing"), [(4, 0), (4, 3), (6, 20)])
def test_covariances_are_those_of_the_full_system(n, missing):
    u = nominal_targets(20)
    rng = np.random.default_rng(3)
    noise = rng.uniform(0.5e-6, 2e-6, (n, 20))
    seen = np.ones((n, 20), dtype=bool)
    for i in rng.choice(20, missing, replace=False):
        seen[rng.integers(n), i] = False
    network = bound(u, NEAR[:n], noise=noise, seen=seen)
    C = dense_covariance(u, NEAR[:n], np.where(seen, 1 / noise, 0.0), np.isfinite(network.target[:, 0]))
    scale = np.abs(C[:60, :60]).max()
    blocks = C[:60, :60].reshape(20, 3, 20, 3)[np.arange(20), :, np.arange(20)]
    # Eight digits: the condition of the bordered system is its square.
    assert np.abs(network.covariance - blocks).max() < 1e-8 * scale
    assert np.abs(joint(network) - C[:60, :60]).max() < 1e-8 * scale
    assert np.abs(station_covariance(network.solved) - C[60:, 60:]).max() < 1e-8 * np.abs(C[60:, 60:]).max()


def test_redundancies_are_those_of_the_hat_matrix():
    u = nominal_targets(14)
    network = bound(u, NEAR[:5], noise=NOISE)
    J = jacobian(u, network.stations, np.ones((5, 14), dtype=bool)) / NOISE
    hat = J @ dense_covariance(u, NEAR[:5], np.full((5, 14), 1 / NOISE), np.isfinite(network.target[:, 0])) @ J.T
    assert np.abs(network.redundancy.T.ravel() - (1 - np.diag(hat))).max() < 1e-6
    assert network.redundancy.sum() == pytest.approx(network.freedom, rel=1e-8)


def test_stated_uncertainty_is_correct():
    u, seeds = nominal_targets(40), 60
    truth = bound(u, NEAR[:4], noise=NOISE)
    targets, stations, squares = [], [], []
    for seed in range(seeds):
        network = solve(measured(u, NEAR[:4], NOISE, seed), u, noise=NOISE)
        targets.append(network.target - u)
        stations.append(network.stations.position - NEAR[:4])
        squares.append(network.sigma0**2 * network.freedom)
    targets, stations = np.array(targets), np.array(stations)
    inside = np.abs(targets) < norm.isf(0.025) * np.sqrt(np.diagonal(truth.covariance, axis1=1, axis2=2))
    # 7200 values in some 60 x 114 independent ones: the share scatters by 0.3 %.
    assert abs(inside.mean() - 0.95) < 4 * np.sqrt(0.95 * 0.05 / (seeds * 114))
    values, vectors = np.linalg.eigh(joint(truth))
    free = values > 1e-6 * values[-1]
    assert np.count_nonzero(free) == 120 - 6
    # All errors at once, with all their correlations: chi squared.
    white = targets.reshape(seeds, -1) @ vectors[:, free] / np.sqrt(values[free])
    assert chi2.sf(np.sum(white**2), white.size) > 1e-4
    assert chi2.cdf(np.sum(white**2), white.size) > 1e-4
    # Residuals: 40 equations, 10 unknowns of the stations.
    assert 1e-4 < chi2.cdf(np.sum(squares), 30 * seeds) < 1 - 1e-4
    places = stations / np.sqrt(np.diagonal(truth.station_covariance, axis1=1, axis2=2))
    # 12 coordinates that share 10 freedoms, the weakest of them much: as if 60 x 4 independent ones.
    assert abs(np.mean(np.abs(places) < norm.isf(0.025)) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / (seeds * 4))


@pytest.mark.parametrize("off", [1e-6, 300e-6, 1e-3])
def test_the_size_of_the_errors_of_many_targets_does_not_matter(off):
    u = nominal_targets(3000)
    true = u + np.random.default_rng(1).normal(0, off, u.shape)
    d = measured(true, NEAR[:4], NOISE)
    d[2, 5:900:7] = np.nan
    far = solve(d, u, NEAR[:4] + 2e-3, noise=NOISE, robust=False)
    near = solve(d, true, NEAR[:4] + 2e-3, noise=NOISE, robust=False)
    between = np.linalg.norm(far.target[:500] - far.target[500:1000], axis=1)
    assert np.abs(between - np.linalg.norm(near.target[:500] - near.target[500:1000], axis=1)).max() < 1e-12
    assert far.sigma0 == pytest.approx(near.sigma0, rel=1e-9)


def test_cached_quantities_do_not_depend_on_the_order_of_access():
    # Readings may change hands after a solution: what it is asked for later is of the readings that it had.
    u = nominal_targets(40)
    d = measured(u, NEAR[:4], NOISE)
    early, late = solve(d, u, noise=NOISE), solve(d, u, noise=NOISE)
    residual = early.residual.copy()
    d += 1.0
    u += 1.0
    assert np.array_equal(late.residual, residual)
    assert np.array_equal(late.covariance, early.covariance)


def test_missing_distances_increase_the_uncertainty_as_predicted():
    u = nominal_targets(30)
    d = measured(u, NEAR[:4], NOISE)
    d[:2, 4], d[3, 11], d[0, 20] = np.nan, np.nan, np.nan
    network = solve(d, u, noise=NOISE)
    assert np.isnan(network.target[4]).all()
    assert np.isnan(network.covariance[4]).all()
    assert np.isfinite(np.delete(network.target, 4, axis=0)).all()
    # Three distances give a place, but say nothing about the stations.
    assert network.freedom == 30 - 3 - 10
    assert network.uncertainty[11] > np.nanmedian(network.uncertainty)


def test_a_less_accurate_station_has_less_weight():
    u = nominal_targets(60)
    sigma = np.array([1e-6, 1e-6, 1e-6, 1e-6, 20e-6])
    d = measured(u, NEAR[:5], sigma[:, None])
    network = solve(d, u, noise=sigma[:, None])
    assert network.sigma0 == pytest.approx(1.0, abs=4 / np.sqrt(2 * network.freedom))
    four = bound(u, NEAR[:4], noise=NOISE).uncertainty
    assert (network.uncertainty < four * (1 + 1e-9)).all()
    assert (network.uncertainty > bound(u, NEAR[:5], noise=NOISE).uncertainty).all()


def test_drift_is_estimated_with_its_uncertainty():
    u = nominal_targets(80)
    # One station's displacements are off in proportion to the time of the reading.
    time = np.zeros((4, 80))
    time[1] = np.linspace(0, 1, 80)
    drift, found = Sources(drift=[Shared("drift", 70e-6 * time)]), []
    for seed in range(40):
        d = measured(u, NEAR[:4], NOISE, seed) + 7e-6 * time
        network = solve(d, u, noise=NOISE, sources=drift)
        off = network.solved.fit.unknowns.drift[1, 0] - 0.1
        found.append(off / np.sqrt(network.solved.fit.normal.covariance[-1, -1]))
    assert 1e-4 < chi2.cdf(np.sum(np.square(found)), 40) < 1 - 1e-4


def test_the_effect_of_a_source_is_that_of_changed_readings():
    u = nominal_targets(40)
    d = measured(u, NEAR[:4], NOISE)
    d[1, 3] = np.nan
    change = 2e-6 * np.cos(np.arange(160.0)).reshape(4, 40)
    sources = Sources(air={"air": 1e-6}, scales=[Shared("a", change)])
    before = solve(d, u, noise=NOISE, robust=False, sources=sources)
    effect = {source.name: source.effect for source in before.solved.relative.errors.sources}
    for name, by in (("a", change), ("air", 1e-6 * d)):
        after = solve(d + by, u, noise=NOISE, robust=False)
        moved = effect[name]
        # Second order: some 50 um of the stations over their distance of 0.2 m, 3e-4 of the effect.
        assert np.abs(after.target - before.target - moved).max() < 1e-3 * np.abs(moved).max()


def test_inaccurate_approximate_positions_have_no_effect():
    u = nominal_targets(30)
    d = measured(u, NEAR[:4], NOISE)
    near = solve(d, u, NEAR[:4], noise=NOISE)
    far = solve(d, u, NEAR[:4] + np.random.default_rng(2).normal(0, 0.05, (4, 3)), noise=NOISE)
    assert np.abs(near.target - far.target).max() < 1e-12


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"target": np.zeros((9, 3))}, "network.shape"),
        ({"noise": 0.0}, "network.noise.not_positive"),
        ({"station": np.zeros((3, 3))}, "network.stations.shape"),
    ],
)
def test_wrong_shapes_are_refused(change, code):
    u = nominal_targets(12)
    given = {"target": u, "station": NEAR[:4], "noise": NOISE} | change
    with raises(code):
        solve(measured(u, NEAR[:4]), given.pop("target"), given.pop("station"), **given)
