"""Programs on a virtual machine with known errors: the tool reaches the programmed positions."""

import numpy as np
import pytest
from nc_paths import ORIGINS, dense, deviations, moves_of

from errormotion.compensation.correction import correction
from errormotion.compensation.program.tools import ByTool
from errormotion.twin import VirtualMachine

TOLERANCE = 1e-6
DIGITS = 1e-7
PROGRAM = [
    *(
        "G21 G90 G17 G54",
        "G0 X-150 Y-100 Z120",
        "F800",
        "G1 Z100",
        "X150",
        "Y100",
        "G3 X100 Y150 I-50 J0",
        "G1 X-150",
    ),
    *(
        "G2 X-100 Y40 R80",
        "G18 G3 X-60 Z140 I20 K20",
        "G19 G2 Y0 Z100 J-20 K-20",
        "G1 X0 Y0 Z200",
        "G17 G3 I30 Z210 P2",
    ),
]


def machine_and_truth(kind: str) -> tuple[VirtualMachine, object]:
    machine = VirtualMachine(kind, 3)
    # beyond the program, 20 to 30 mm apart: interpolation adds less than 0.1 um
    lines = [np.linspace(-0.18, 0.18, 13), np.linspace(-0.13, 0.17, 11), np.linspace(0.09, 0.35, 14)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    return machine, machine.volumetric_truth(points)


def displaced(machine: VirtualMachine, tool: np.ndarray) -> object:
    """Return the positions of the tool for commanded positions."""
    geometry = machine.geometry

    def actual(commanded: np.ndarray) -> np.ndarray:
        errors = geometry.machine.errors_at(commanded, geometry.motions, geometry.locations)
        return commanded + geometry.machine.volumetric_error(commanded, errors, tool, exact=True)[:, :3]

    return actual


@pytest.mark.parametrize("tool", [0.0, 0.1])
def test_cuts_on_the_machine_follow_the_programmed_path(tool: float) -> None:
    machine, truth = machine_and_truth("cframe")
    point = np.array([0.0, 0.002, -tool]) if tool else np.zeros(3)
    correcting = ByTool(correction(truth), np.array([0.0, 0.004, 0.0]) if tool else None)
    lines = PROGRAM if not tool else [PROGRAM[0], f"G43.1 Y2 Z{1e3 * tool:g}", *PROGRAM[1:]]
    before = [away for _, away in deviations(lines, lambda p, _: Nothing(p), displaced(machine, point))]
    after = [away for _, away in deviations(lines, correcting, displaced(machine, point), tolerance=TOLERANCE)]
    assert max(before) > 5e-6
    assert max(after) <= TOLERANCE + DIGITS + 0.1e-6


class Nothing:
    """No correction."""

    def __init__(self, places: np.ndarray) -> None:
        self.offset, self.valid = np.zeros_like(places), np.ones(len(places), bool)


def test_tools_without_a_gauge_point_share_the_functional_point() -> None:
    _, truth = machine_and_truth("cframe")
    places = np.array([[0.0, 0.0, 0.15], [0.1, 0.05, 0.12]])
    tools = np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.2]])
    found = correction(truth)
    assert np.array_equal(ByTool(found)(places, tools).offset, found.at(places).offset)
    with_gauge = ByTool(found, np.zeros(3)).values(places, tools, covariance=True)
    alone = [found.for_tool(-tool).at(place[None]).offset[0] for place, tool in zip(places, tools, strict=True)]
    assert np.allclose(with_gauge.offset, alone, atol=1e-15)
    assert with_gauge.covariance is not None
    assert ORIGINS.tools


def test_the_remaining_error_on_the_machine_is_within_the_stated_uncertainty() -> None:
    machine, truth = machine_and_truth("cframe")
    rng = np.random.default_rng(5)
    sigma = 0.5e-6
    measured = truth.copy()
    for name in ("EX", "EY", "EZ"):
        measured[name] = truth[name] + sigma * rng.normal(size=truth[name].shape)
    variance = np.diag([sigma**2] * 3 + [0.0] * 3)
    measured = measured.assign(covariance=(truth["covariance"].dims, np.tile(variance, (truth.sizes["target"], 1, 1))))
    correcting = ByTool(correction(measured))
    places = np.concatenate([dense(move, 20) for move in moves_of(PROGRAM)])
    stated = correcting.values(places, np.zeros_like(places), covariance=True).covariance
    u = np.sqrt(np.linalg.eigvalsh(stated)[:, -1].max())
    after = [away for _, away in deviations(PROGRAM, correcting, displaced(machine, np.zeros(3)), tolerance=TOLERANCE)]
    assert u < 2 * sigma
    assert max(after) <= TOLERANCE + DIGITS + 4 * u  # the largest of some hundred independent values
