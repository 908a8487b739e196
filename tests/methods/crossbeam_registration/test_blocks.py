"""A scan reduced to blocks: the compiled loop against plain numpy, what dirt does, what is refused."""

import subprocess
import sys

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification.registration import kernels, prepare
from errormotion.methods.crossbeam_scan.identification.registration.surface import Surface


def plane_of(block, dx, dy):
    """Height and slopes of the plane through a block's points by least squares, and their scatter."""
    X, Y = np.meshgrid(dx, dy)
    known = np.isfinite(block)
    rows = np.column_stack([np.ones(known.sum()), X[known], Y[known]])
    p, *_ = np.linalg.lstsq(rows / [1, 1e-4, 1e-4], block[known], rcond=None)
    p = p / [1, 1e-4, 1e-4]
    return p, np.sum((block[known] - rows @ p) ** 2) / (known.sum() - 3), np.linalg.inv(rows.T @ rows)[0, 0]


def reduced(z, x, y, scale):
    dx = np.ascontiguousarray((x - x[:16].mean())[:16])
    rows = z.shape[0] // 4
    dy = y[: rows * 4].reshape(rows, 4)
    dy = np.ascontiguousarray(dy - dy.mean(axis=1, keepdims=True))
    return kernels.reduce_blocks(z, dx, dy, scale), dx, dy


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_blocks_are_planes_by_least_squares(scanner, missing):
    rng = np.random.default_rng(0)
    z, x, y = scanner.scan(rng)
    z[rng.random(z.shape) < missing] = np.nan
    out, dx, dy = reduced(z, x, y, 1e-3)
    for row, column in [(0, 0), (13, 77), (99, 99), (50, 3)]:
        block = z[row * 4 : row * 4 + 4, column * 16 : column * 16 + 16].astype(float)
        (m, sx, sy), scatter, gain = plane_of(block, dx, dy[row])
        # Sums of 64 differences of some 10 um in single precision keep 1e-7 of them.
        assert out[0, row, column] == pytest.approx(m, rel=0, abs=1e-11)
        np.testing.assert_allclose(out[1:3, row, column], [sx, sy], rtol=0, atol=1e-6)
        assert out[3, row, column] == pytest.approx(scatter, rel=2e-3)
        assert out[4, row, column] == np.isfinite(block).sum()
        assert out[5, row, column] == pytest.approx(gain, rel=1e-5)


def test_a_block_answers_curvature_as_it_says(scanner):
    rng = np.random.default_rng(1)
    x, y = scanner.x[:160], scanner.y[:40]
    X, Y = np.meshgrid(x, y)
    hole = rng.random(X.shape) < 0.2
    for n, curved in ((6, X**2 / 2), (7, Y**2 / 2), (8, X * Y)):
        z = curved.astype(np.float32)
        z[hole] = np.nan
        out, *_ = reduced(z, x, y, 1e-3)
        yc, xc = y.reshape(-1, 4).mean(axis=1)[:, None], x.reshape(-1, 16).mean(axis=1)
        there = {6: xc**2 / 2 + 0 * yc, 7: yc**2 / 2 + 0 * xc, 8: xc * yc}[n]
        # Heights of up to 2e-4 m^2 in single precision.
        np.testing.assert_allclose(out[0] - there, out[n], rtol=0, atol=2e-11)


def test_heights_are_those_of_the_surface_not_of_its_means(make_scanner):
    scanner = make_scanner(noise=0.0)
    found = prepare(*scanner.scan(np.random.default_rng(0)))
    truth = scanner.surface(*np.meshgrid(found.x, found.y))[0]
    plain = scanner.true_heights().reshape(100, 4, 100, 16).mean(axis=(1, 3))
    assert np.abs(plain - truth).max() > 300e-9
    # Second differences leave h^4 z'''' / 300 or 1 nm, at the edge h^4 z'''' / 24; without noise the most curved
    # blocks lose their outermost points, which costs some more.
    assert np.abs(found.height - truth)[1:-1, 1:-1].max() < 20e-9
    assert np.std(found.height - truth) < 3e-9


def test_noise_is_that_of_the_points_although_blocks_are_curved(scanner):
    found = prepare(*scanner.scan(np.random.default_rng(2)))
    # A median over 5000 blocks of 61 degrees of freedom each is good to 0.2 %, its own offset is 0.5 %.
    assert found.noise == pytest.approx(scanner.noise, rel=0.02)


@pytest.mark.parametrize("amplitude", [5e-6, 50e-6, 5e-3])
def test_spikes_do_not_move_a_block(scanner, amplitude):
    rng = np.random.default_rng(3)
    z, x, y = scanner.scan(rng)
    clean = prepare(z, x, y)
    wrong = rng.random(z.shape) < 0.05
    z[wrong] += (amplitude * rng.choice([-1, 1], wrong.sum())).astype(np.float32)
    dirty = prepare(z, x, y)
    # Without them the height has 0.5 um / 8 = 62 nm of noise; leaving 5 % out changes it by sqrt(0.05) of that.
    shift = (dirty.height - clean.height)[dirty.known]
    assert np.std(shift) < 30e-9
    assert dirty.known.mean() > 0.999


def test_what_is_missing_is_marked_and_filled(scanner):
    z, x, y = scanner.scan(np.random.default_rng(4))
    truth = prepare(z, x, y)
    z = z.copy()
    z[100:140, 400:560] = np.nan
    found = prepare(z, x, y)
    hole = np.zeros(found.known.shape, dtype=bool)
    hole[25:35, 25:35] = True
    np.testing.assert_array_equal(~found.known, hole)
    assert (found.points[hole] == 0).all()
    # The rim of the hole goes on smoothly: a tenth of the 40 um that the surface rises across a block.
    assert np.abs(found.height - truth.height)[25, 27:33].max() < 4e-6


def test_uneven_profiles_are_read_where_they_are(make_scanner):
    scanner = make_scanner(noise=0.0)
    even = prepare(*scanner.scan(np.random.default_rng(0)))
    scanner.y = scanner.y + np.random.default_rng(1).uniform(-20e-6, 20e-6, scanner.y.size)
    found = prepare(*scanner.scan(np.random.default_rng(0)))
    truth = scanner.surface(*np.meshgrid(found.x, found.y))[0]
    # Without the places of the profiles a slope of 0.3 would make 20 um / 2 of it 3 um.
    assert np.abs(found.height - truth)[1:-1, 1:-1].max() < 0.1e-6
    assert np.abs(even.y - found.y).max() < 20e-6


def test_surface_is_exact_for_cubics_up_to_its_edge():
    x, y = np.arange(8) * 0.2e-3, np.arange(9) * 0.28e-3
    X, Y = np.meshgrid(x * 1e3, y * 1e3)
    surface = Surface.through(X**3 - 2 * X * Y**2 + Y**3 + 1, x, y)
    c = surface.coefficients
    # Half way before the first node along x, on the nodes along y: weights of the four B-splines at t = -1/2.
    t = -0.5
    w = [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * (1 - t) ** 2 + 3 * (1 - t) ** 3, t**3]
    along = (c[:-2] + 4 * c[1:-1] + c[2:]) / 6
    at = -0.1
    Yn = Y[:, 0]
    np.testing.assert_allclose(along[:, :4] @ w / 6, at**3 - 2 * at * Yn**2 + Yn**3 + 1, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda z, x, y: (z, x * 1e3, y * 1e3), "millimetres"),
        (lambda z, x, y: (z, x, np.concatenate([y[:200], y[:200]])), "encoder"),
        (lambda z, x, y: (z, x, np.where(np.arange(y.size) > 200, y + 5e-3, y)), "lost pulses"),
        (lambda z, x, y: (z[:200], x, y), "shape"),
        (lambda z, x, y: (z[:12], x, y[:12]), "at least 32 profiles"),
        (lambda z, x, y: (np.full_like(z, np.nan), x, y), "exposure"),
        (lambda z, x, y: (z, x, np.where(np.arange(y.size) == 7, np.nan, y)), "rise"),
    ],
)
def test_wrong_scans_are_refused_with_what_to_do(scanner, change, message):
    z, x, y = scanner.scan(np.random.default_rng(0))
    with pytest.raises(MethodError, match=message):
        prepare(*change(z, x, y))


SAME_BITS = """
import numpy as np
from errormotion import compiling
from errormotion.methods.crossbeam_scan.identification.registration import comparison, prepare, register
comparison.COMPILED_FROM = comparison.MANY = 0
rng = np.random.default_rng(0)
x, y = np.arange(800) * 12.5e-6, np.arange(300) * 70e-6
X, Y = np.meshgrid(x, y)
z = 1e-3 * np.sin(600 * X + 100 * Y) + 1e-3 * np.cos(500 * Y - 80 * X)
cold, warm = (z + 5e-7 * rng.standard_normal((2, *z.shape))).astype(np.float32)
warm[rng.random(z.shape) < 0.02] = np.nan
cold[rng.random(z.shape) < 0.02] += 1e-4
seen = set()
for threads in (1, 2):
    compiling.threads = lambda: threads
    found = register(prepare(cold, x, y), prepare(warm, x, y))
    seen.add(found.pose.as_matrix().tobytes() + found.covariance.tobytes() + found.residual.tobytes())
print(len(seen))
"""


def test_one_thread_and_two_give_the_same_bits():
    done = subprocess.run(
        [sys.executable, "-c", SAME_BITS],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["1"]
