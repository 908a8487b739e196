"""From the errors of targets to those of the axes, and to any other position of the volume."""

import numpy as np
import pytest
from coded import raises
from numpy.polynomial.legendre import leggauss

from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.twists import cross_matrix, move
from errormotion.methods.multilateration import simulation
from errormotion.methods.multilateration.axes import fit_machine, misfit_note, reference_of
from errormotion.twin import VirtualMachine

REFLECTOR = np.array([0.02, -0.01, -0.08])
NOISE = 0.3e-6


def targets(seed, count=(6, 6, 5), noise=NOISE, reflectors=(REFLECTOR,), kind="cframe"):
    """Return machine, axis positions, reflectors, and errors with their covariances."""
    machine = VirtualMachine(kind, seed=seed)
    q = np.concatenate([simulation.target_grid(machine, count)] * len(reflectors))
    at = np.repeat(np.array(reflectors), len(q) // len(reflectors), axis=0)
    twist = machine.geometry.twist(q)
    error = twist[:, :3] + np.cross(twist[:, 3:], at)
    error = error + noise * np.random.default_rng(seed).normal(size=error.shape)
    return machine, q, at, error, np.tile(noise**2 * np.eye(3), (len(q), 1, 1)), np.zeros((0, len(q), 3))


def true_curve(machine, name, position, reference):
    """Return an error motion at a reference, minus its mean and, for a straightness, its slope over the range."""
    axis, k = name[2], DOF.index(name[:2])
    low, high = position[0], position[-1]
    x, w = leggauss(40)

    def motion(at):
        twist = move(machine.geometry.motions[axis](at), reference)
        # A table that carries the workpiece: what turns with it has a lever along its own travel.
        return twist[:, k] - (at * twist[:, 5] if name == "EXY" and "-Y-bed" in machine.chain else 0.0)

    inside = motion((low + high) / 2 + x * (high - low) / 2)
    mean, slope = (w * inside).sum() / 2, 1.5 * (w * inside * x).sum()
    share = np.linspace(-1, 1, len(position))
    return motion(position) - mean - (slope * share if k < 3 and name[1] != axis else 0.0)


@pytest.mark.parametrize("kind", ["cframe", "gantry"])
def test_curves_agree_with_the_true_ones_within_their_uncertainty(kind):
    held = []
    for seed in range(4):
        machine, q, at, error, own, none = targets(seed, kind=kind)
        axes = fit_machine(machine.chain, q, error, own, none, reflector=at)
        for k, axis in enumerate("XYZ"):
            position = np.linspace(axes.volume.low[k], axes.volume.high[k], 21)
            for name in (dof + axis for dof in DOF):
                if name not in axes.undetermined:
                    value, u = axes.curve(name, position)
                    held.append(np.abs(value - true_curve(machine, name, position, REFLECTOR)) <= 2 * u)
    # Some 56 curves of some 4 independent values each: 95 % to 1.5 %, and the prior is not the machine's.
    assert 0.88 < np.mean(held) <= 1


def test_squareness_is_that_of_the_mean_lines():
    # Without noise and with all orders the only freedom left is the convention, which two grids share.
    found = []
    for count in ((9, 9, 9), (8, 7, 9)):
        machine, q, at, error, own, none = targets(3, count, noise=1e-9)
        found.append(fit_machine(machine.chain, q, error, own, none, reflector=at, max_order=8).locations())
    for name in ("EC0Y", "EA0Z", "EB0Z"):
        (a, u), (b, v) = found[0][name], found[1][name]
        assert abs(a - b) < 4 * np.hypot(u, v)
        assert 0 < u < 1e-6


def test_a_single_squareness_is_determined_without_other_errors():
    machine, q, at, _, own, none = targets(0)
    wanted = dict.fromkeys(machine.geometry.machine.error_names, 0.0) | {"EA0Z": 20e-6}
    errors = np.array(list(wanted.values()))
    error = machine.geometry.machine.volumetric_error(q, errors, REFLECTOR)[:, :3]
    axes = fit_machine(machine.chain, q, error, own, none, reflector=at)
    for name, (value, u) in axes.locations().items():
        assert value == pytest.approx(wanted[name], abs=1e-9)
        assert u < 1e-6
    x = np.linspace(*axes.volume.low[:1], *axes.volume.high[:1], 5)
    assert np.abs(axes.curve("EYX", x)[0]).max() < 1e-9


def test_one_reflector_does_not_determine_the_rotations_of_its_axis():
    machine, q, at, error, own, none = targets(1)
    axes = fit_machine(machine.chain, q, error, own, none, reflector=at)
    assert set(axes.undetermined) == {"ECY", "EAZ", "EBZ", "ECZ"}
    assert axes.undetermined["ECY"].like == ("EXY",)
    assert axes.undetermined["EAZ"].reason == "no effect on the reflector"
    value, u = axes.curve("EAZ", np.array([0.2]))
    assert np.isnan(value).all()
    assert np.isnan(u).all()


def test_three_reflectors_determine_all_21():
    reflectors = [(0.0, 0.0, -0.1), (0.1, 0.0, -0.1), (0.0, 0.1, -0.2)]
    machine, q, at, error, own, none = targets(2, (5, 5, 4), reflectors=reflectors)
    axes = fit_machine(machine.chain, q, error, own, none, reflector=at)
    assert not axes.undetermined
    assert len({term.error for term in axes.terms}) == 21
    z = np.linspace(axes.volume.low[2], axes.volume.high[2], 9)
    value, u = axes.curve("ECZ", z)
    truth = true_curve(machine, "ECZ", z, reference_of(axes))
    assert np.all(np.abs(value - truth) < 4 * u)
    assert np.ptp(truth) > 4 * u.mean()


def test_rigid_motions_have_no_effect():
    machine, q, at, error, own, none = targets(4)
    G = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -cross_matrix(q)], axis=2)
    moved = error + G @ np.array([1e-5, -2e-5, 3e-5, 1e-5, 2e-5, -3e-5])
    one, other = (fit_machine(machine.chain, q, e, own, none, reflector=at) for e in (error, moved))
    # Rounding alone: 1e-5 against digits of 1e-16, times the condition of the least squares.
    np.testing.assert_allclose(other.coefficient, one.coefficient, atol=1e-11)


def test_the_uncertainty_of_the_scale_affects_positioning_but_not_straightness():
    machine, q, at, error, own, _ = targets(5)
    scale = 5e-6 * (q - q.mean(axis=0))[None]
    plain = fit_machine(machine.chain, q, error, own, np.zeros((0, len(q), 3)), reflector=at)
    unsure = fit_machine(machine.chain, q, error, own, scale, reflector=at)

    def end(axes, name):
        return axes.curve(name, axes.volume.high[:1])[1][0]

    half = np.ptp(q[:, 0]) / 2
    assert end(unsure, "EXX") == pytest.approx(np.hypot(end(plain, "EXX"), 5e-6 * half), rel=0.05)
    assert end(unsure, "EYX") == pytest.approx(end(plain, "EYX"), rel=0.05)


def test_errors_that_no_axis_explains_increase_the_uncertainty():
    machine, q, at, error, own, none = targets(6)
    odd = error.copy()
    odd[:, 0] += 5e-6 * np.sign(np.sin(97 * q @ np.array([1.0, 2.0, 3.0])))  # no chain of axes does this
    plain, bent = (fit_machine(machine.chain, q, e, own, none, reflector=at) for e in (error, odd))
    assert bent.sigma0 > 3
    assert "not rigid" in misfit_note(bent, 12)[0]
    assert not misfit_note(plain, 12)
    assert bent.locations()["EC0Y"][1] > 3 * plain.locations()["EC0Y"][1]


def test_unknown_targets_are_ignored():
    machine, q, at, error, own, none = targets(7)
    error[:20] = np.nan
    axes = fit_machine(machine.chain, q, error, own, none, reflector=at)
    assert np.isfinite(axes.coefficient).all()


def test_one_position_of_an_axis_does_not_determine_its_errors():
    machine, q, at, error, own, none = targets(8, (6, 6, 1))
    axes = fit_machine(machine.chain, q, error, own, none, reflector=at)
    assert axes.undetermined["EZZ"].reason == "too few positions of Z"
    assert axes.undetermined["EA0Z"].reason == "too few positions of Z"
    assert "EXX" not in axes.undetermined


@pytest.mark.parametrize("chain", ["workpiece-X-Y-bed-C-Z-tool", "X-Y-Z", "workpiece-X-bed-Z-tool"])
def test_another_machine_is_refused(chain):
    _, q, at, error, own, none = targets(0)
    with pytest.raises(MethodError, match=r"expected|Chain"):
        fit_machine(chain, q, error, own, none, reflector=at)


def test_too_few_targets_are_refused():
    machine, q, at, error, own, none = targets(0)
    with raises("network.targets.too_few"):
        fit_machine(machine.chain, q[:8], error[:8], own[:8], none[:, :8], reflector=at[:8])
