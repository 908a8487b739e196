"""A scan reduced to blocks: against plain numpy and against the compiled loop, what dirt does, what is refused."""

import numpy as np
import pytest
from coded import raises

from errormotion import compiling
from errormotion.methods.crossbeam_scan.identification.registration import (
    blocks,
    kernels,
    prepare,
    reduction,
    register,
    surface,
)
from errormotion.methods.crossbeam_scan.identification.registration.surface import Surface


def plane_of(block, dx, dy):
    """Height and slopes of the plane through a block's points by least squares, and their scatter."""
    X, Y = np.meshgrid(dx, dy)
    known = np.isfinite(block)
    rows = np.column_stack([np.ones(known.sum()), X[known], Y[known]])
    p, *_ = np.linalg.lstsq(rows / [1, 1e-4, 1e-4], block[known], rcond=None)
    p = p / [1, 1e-4, 1e-4]
    return p, np.sum((block[known] - rows @ p) ** 2) / (known.sum() - 3), np.linalg.inv(rows.T @ rows)[0, 0]


def reduced(z, x, y, scale, compiled=False):
    dx = np.ascontiguousarray((x - x[:16].mean())[:16])
    rows = z.shape[0] // 4
    dy = y[: rows * 4].reshape(rows, 4)
    dy = np.ascontiguousarray(dy - dy.mean(axis=1, keepdims=True))
    return reduction.reduce_blocks(z, dx, dy, scale, compiled), dx, dy


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_blocks_are_planes_by_least_squares(scanner, missing, compiled):
    rng = np.random.default_rng(0)
    z, x, y = scanner.scan(rng)
    z[rng.random(z.shape) < missing] = np.nan
    out, dx, dy = reduced(z, x, y, 1e-3, compiled)
    for row, column in [(0, 0), (13, 77), (99, 99), (50, 3)]:
        block = z[row * 4 : row * 4 + 4, column * 16 : column * 16 + 16].astype(float)
        (m, sx, sy), scatter, gain = plane_of(block, dx, dy[row])
        # The least squares lose five digits by the heights' offset of 1 mm, and the normal equations by the slopes.
        assert out[0, row, column] == pytest.approx(m, rel=0, abs=1e-15)
        np.testing.assert_allclose(out[1:3, row, column], [sx, sy], rtol=0, atol=1e-11)
        assert out[3, row, column] == pytest.approx(scatter, rel=1e-8)
        assert out[4, row, column] == np.isfinite(block).sum()
        assert out[5, row, column] == pytest.approx(gain, rel=1e-10)


def dirty(scanner, rng):
    """Return a scan with holes, spikes, lost points, and lines off by a common deviation."""
    z, x, y = scanner.scan(rng)
    z[rng.random(z.shape) < 0.02] = np.nan
    z[rng.random(z.shape) < 0.02] += np.float32(5e-6)
    z[rng.random(z.shape) < 0.02] += np.float32(1e-3)
    z[100:140, 400:560] = np.nan
    z[200:204] += 4 * scanner.noise * rng.standard_normal((4, z.shape[1]), dtype=np.float32)
    z[:, :16][rng.random((len(z), 16)) < 0.4] = np.nan
    return z, x, y


def test_compiled_loops_give_the_same_blocks(scanner):
    z, x, y = dirty(scanner, np.random.default_rng(5))
    plain, *_ = reduced(z, x, y, scanner.noise)
    compiled, *_ = reduced(z, x, y, scanner.noise, compiled=True)
    assert 0.3 < np.mean(plain[4] < 64) < 1
    assert np.isnan(plain[0]).any()
    np.testing.assert_array_equal(plain[4], compiled[4])
    # Both choose the same points; their sums differ by rounding.
    largest = np.nanmax(np.abs(plain), axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(plain / largest, compiled / largest, rtol=0, atol=1e-12)


def spread_one_by_one(height, sx, sy, pitch_x, pitch_y):
    """Fill what is NaN by the mean of the neighbours' planes, outwards."""
    while np.isnan(height).any():
        known = ~np.isnan(height)
        before = height.copy(), sx.copy(), sy.copy()
        for i, j in np.argwhere(~known):
            near = [(p, q) for p in (i - 1, i, i + 1) for q in (j - 1, j, j + 1)]
            near = [(p, q) for p, q in near if 0 <= p < len(known) and 0 <= q < known.shape[1] and known[p, q]]
            if near:
                h, gx, gy = (np.array([values[at] for at in near]) for values in before)
                p, q = np.array(near).T
                height[i, j] = np.mean(h + gx * (j - q) * pitch_x + gy * (i - p) * pitch_y)
                sx[i, j], sy[i, j] = gx.mean(), gy.mean()


def relaxed_one_by_one(height, filled, sweeps):
    """Let fourth differences vanish at one block after the other."""
    for _ in range(sweeps):
        for i, j in filled:
            found = []
            for line, k in ((height[:, j], i), (height[i], j)):
                if 2 <= k < len(line) - 2:
                    found.append(4.0 * (line[k - 1] + line[k + 1]) - line[k - 2] - line[k + 2])
            if found:
                height[i, j] = sum(found) / (6 * len(found))


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_holes_are_filled_as_one_block_after_the_other(share):
    rng = np.random.default_rng(6)
    height, sx, sy = rng.standard_normal((3, 17, 14))
    height[rng.random(height.shape) < share] = np.nan
    height[:5, :4] = np.nan
    plain = height.copy(), sx.copy(), sy.copy()
    lost = np.argwhere(np.isnan(height))
    spread_one_by_one(*plain, 0.2, 0.28)
    relaxed_one_by_one(plain[0], lost, surface.SWEEPS)
    found = surface.repaired(height, sx, sy, 0.2, 0.28)
    for one, other in zip(plain, found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


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
    spline = Surface.through(X**3 - 2 * X * Y**2 + Y**3 + 1, x, y)
    c = spline.coefficients
    # Half way before the first node along x, on the nodes along y: weights of the four B-splines at t = -1/2.
    t = -0.5
    w = [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * (1 - t) ** 2 + 3 * (1 - t) ** 3, t**3]
    along = (c[:-2] + 4 * c[1:-1] + c[2:]) / 6
    at = -0.1
    Yn = Y[:, 0]
    np.testing.assert_allclose(along[:, :4] @ w / 6, at**3 - 2 * at * Yn**2 + Yn**3 + 1, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda z, x, y: (z, x * 1e3, y * 1e3), "registration.positions.unit"),
        (lambda z, x, y: (z, x, np.concatenate([y[:200], y[:200]])), "registration.positions.order"),
        (lambda z, x, y: (z, x, np.where(np.arange(y.size) > 200, y + 5e-3, y)), "registration.positions.uneven"),
        (lambda z, x, y: (z[:200], x, y), "registration.heights.shape"),
        (lambda z, x, y: (z[:12], x, y[:12]), "registration.scan.too_small"),
        (lambda z, x, y: (np.full_like(z, np.nan), x, y), "registration.heights.missing"),
        (lambda z, x, y: (z, x, np.where(np.arange(y.size) == 7, np.nan, y)), "registration.positions.order"),
    ],
)
def test_wrong_scans_are_refused_with_what_to_do(scanner, change, code):
    z, x, y = scanner.scan(np.random.default_rng(0))
    with raises(code):
        prepare(*change(z, x, y))


def test_one_thread_and_two_give_the_same_bits(monkeypatch):
    monkeypatch.setattr(blocks, "COMPILED_FROM", 0)
    monkeypatch.setattr(kernels, "MANY", 0)
    rng = np.random.default_rng(0)
    x, y = np.arange(800) * 12.5e-6, np.arange(300) * 70e-6
    X, Y = np.meshgrid(x, y)
    z = 1e-3 * np.sin(600 * X + 100 * Y) + 1e-3 * np.cos(500 * Y - 80 * X)
    cold, warm = (z + 5e-7 * rng.standard_normal((2, *z.shape))).astype(np.float32)
    warm[rng.random(z.shape) < 0.02] = np.nan
    cold[rng.random(z.shape) < 0.02] += 1e-4
    seen = set()
    for threads in (1, 2):
        monkeypatch.setattr(compiling, "threads", lambda threads=threads: threads)
        found = register(prepare(cold, x, y), prepare(warm, x, y))
        seen.add(found.pose.as_matrix().tobytes() + found.covariance.tobytes() + found.residual.tobytes())
    assert len(seen) == 1
