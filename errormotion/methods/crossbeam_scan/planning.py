"""What a campaign is expected to give: registrations with their covariance, and the covariance of the profiler's pose.

The artefacts are waves along x and y. Their slopes determine the information of one registration, line by line. A line
that jitters along z and y with the variances t (of both scans) has two additional unknowns, with the columns B and the
information C; its information about the twist is A - B (1/t + C)^-1 B^T, in units of the noise. The chain to the
carriage is that of real registrations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification.chain import carriage_adjoint, from_maps, pose_twists
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.profiler_pose.pose_errors import stated_covariance, stated_pose
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import BASES
from errormotion.methods.crossbeam_scan.identification.registrations import STRAINS, estimated
from errormotion.methods.crossbeam_scan.schema import SCHEMA
from errormotion.methods.crossbeam_scan.settings import PoseSettings

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
    from errormotion.plugins import MethodInfo


EXPECTED_ERRORS = np.array([20e-6, 20e-6, 20e-6, 10e-6, 10e-6, 10e-6])
"""Errors (m, rad) that a plan assumes for the influence of pose and lever."""
PLATE_DISTANCE = 2e-3
"""Distance of the used part of the plate from the pocket, m; each line has the mean of a hundred points there."""
_CELLS = 100  # of a profile
_SINGULAR = 1e12  # condition number


def expected(settings: CrossbeamScanSettings) -> xr.Dataset:
    """Return the registrations of scans without noise, for a carriage on its guide with errors of typical size.

    Raises
    ------
    MethodError
        No ``positions`` in the settings.
    """
    if not settings.positions:
        raise MethodError(
            "A plan needs the positions of the artefacts: set positions, such as ['350 mm', '550 mm']",
            code="scan.positions.missing",
        )
    positions, time = np.array(settings.positions), np.array([0.0, *settings.warm_up])
    stated = settings.profiler_pose or PoseSettings()
    pose, lever = stated_pose(stated), np.array(settings.lever)
    E = np.tile(EXPECTED_ERRORS, (positions.size, 1))
    along = positions - positions.mean()
    E[:, 2] += E[:, 3] * along  # EA = dEZ/dY, EC = -dEX/dY
    E[:, 0] -= E[:, 5] * along
    of_profiler = E @ np.linalg.inv(carriage_adjoint(pose, lever)).T
    shape = time.size, positions.size
    registration = np.zeros((*shape, 6))
    registration[1:] = of_profiler @ np.linalg.inv(from_maps(pose)[:6, :6]).T
    C, effect = registration_covariance(settings)
    known = (np.arange(time.size) > 0)[:, None, None, None]
    scan = ("cycle", "artefact", "direction")
    return xr.Dataset(
        {
            "displacement": (scan, registration[..., :3], {"units": "m"}),
            "rotation": (scan, registration[..., 3:], {"units": "rad"}),
            "registration_covariance": (
                (*scan[:2], "registered", "registered_"),
                known * np.tile(C[:6, :6], (*shape, 1, 1)),
            ),
            "strain_effect": ((*scan[:2], "registered", "strain"), np.tile(effect[:6], (*shape, 1, 1))),
            "cold_share": (scan[:2], np.full(shape, 0.5)),
            "time": ("cycle", time, {"units": "s"}),
            "position": ("artefact", positions, {"units": "m"}),
            "profiler_pose": (("row", "column"), pose.as_matrix()),
            "pose_covariance": (("p", "p_"), stated_covariance(stated)),
            "lever": ("direction", lever, {"units": "m"}),
            "lever_uncertainty": ("direction", np.array(settings.lever_uncertainty), {"units": "m"}),
        },
        {"direction": list("xyz")},
        {"schema": SCHEMA, "machine": "plan"},
    )


def registration_covariance(settings: CrossbeamScanSettings) -> tuple[Array, Array]:
    """Return the expected covariance (9, 9) of (T_Q, R_Q, drift) by noise, and their errors (9, 3) by the strains.

    A rigid scan has no drift. What strains are is stated with `Registrations`.
    """
    layout = settings.layout
    x = (np.arange(_CELLS) + 0.5) / _CELLS * layout.width - layout.width / 2
    lines = max(2, round(settings.scan_length / settings.line_pitch))
    y = np.linspace(-settings.scan_length / 2, settings.scan_length / 2, min(lines, 4 * _CELLS))
    kx, ky = (2 * np.pi / wave for wave in layout.wavelength)
    Y, X = np.meshgrid(y, x, indexing="ij")
    # With these phases, the surface has no symmetry.
    z = layout.relief * (np.sin(kx * X + 0.4) + np.cos(ky * Y - 0.7))
    zx, zy = layout.relief * kx * np.cos(kx * X + 0.4), -layout.relief * ky * np.sin(ky * Y - 0.7)
    n = np.stack([-zx, -zy, np.ones_like(z)], axis=-1)
    Q = np.stack([X, Y, z], axis=-1)
    J = np.concatenate([n, np.cross(Q, n), n * Q[..., 1:2]], axis=-1)
    used = 6 if settings.strain == "rigid" else 9
    strains = estimated(settings)
    stretched = [np.einsum("lpi,ij,lpj->lp", n, BASES[name], Q) for name in strains]
    J = np.stack([*np.moveaxis(J[..., :used], -1, 0), *stretched], axis=-1)
    own = np.stack([np.ones_like(z), zy], axis=-1)
    weight = layout.points / _CELLS / (2 * settings.height_noise**2)
    A, B, C = (weight * np.einsum("lpi,lpj->lij", left, right) for left, right in ((J, J), (J, own), (own, own)))
    jitter = np.diag(2 * np.array([layout.jitter_z, layout.jitter_y]) ** 2 + 1e-24)
    inside = np.linalg.solve(np.linalg.inv(jitter) + C, np.swapaxes(B, 1, 2))
    information = np.sum(A - B @ inside, axis=0) * lines / y.size
    priors = range(used, J.shape[-1])
    information[priors, priors] += np.array([value**-2 for value in strains.values()])
    scale = 1 / np.sqrt(np.diag(information))
    joint = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    out, effect = np.zeros((9, 9)), np.zeros((9, 3))
    out[:used, :used] = joint[:used, :used]
    for k, (name, sigma) in enumerate(strains.items()):
        of = -joint[:used, used + k] / sigma**2
        out[:used, :used] -= sigma**2 * np.outer(of, of)
        effect[:used, STRAINS.index(name)] = of
    return out, effect


def plan_pose(info: MethodInfo, settings: CrossbeamScanSettings) -> xr.Dataset:
    """Return the plan of scans of a pocket: edges of the rim, and the plate next to it.

    Raises
    ------
    MethodError
        The scans do not determine a parameter of the pose.
    """
    nominal = stated_pose(settings.profiler_pose or PoseSettings())
    centre = np.array([*calibration.parameters(nominal), settings.pocket_radius])
    J = np.transpose(
        [
            (_pocket(settings, centre + step) - _pocket(settings, centre - step)) / (2 * step.max())
            for step in np.diag([1e-6] * 3 + [1e-7] * 4)
        ]
    )
    information = J.T @ J
    information[6, 6] += 1 / max(settings.pocket_radius_uncertainty, 1e-9) ** 2
    if settings.angle_prior is not None:
        information[range(3), range(3)] += 1 / settings.angle_prior**2
    scale = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    if np.linalg.cond(information * np.outer(scale, scale)) > _SINGULAR:
        raise MethodError(
            "These scans of the pocket do not determine the pose of the profiler: expected at least two lifts of the "
            f"spindle (pocket_lifts), or an angle_prior; found {len(settings.pocket_lifts)}.",
            code="scan.pocket.undetermined",
        )
    covariance = (np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))[:6, :6]
    edge = calibration.EDGE_UNCERTAINTY
    covariance += np.diag([0.0, 0.0, edge / settings.pocket_radius, edge, edge, 0.0]) ** 2
    at_profiler = pose_twists(nominal, -nominal.translation)
    return build_errors(
        np.zeros((1, 6)),
        (at_profiler.T @ covariance @ at_profiler)[None],
        dims=("beam",),
        coords={"beam": ["profiler"]},
        component="beam",
        machine="plan",
        frame="tool",
        functional_point=np.asarray(nominal.translation),
        reference="planned, not measured",
        method=info.id,
        method_version=info.version,
        provenance=provenance.make(settings, None, None, steps=["plan"]),
    )


def _pocket(settings: CrossbeamScanSettings, parameters: Array) -> Array:
    """Return the observations of the fit of a pocket with (a, b, g, dx, dy, dz, r), in units of its noise."""
    layout, radius = settings.layout, settings.pocket_radius
    nominal = stated_pose(settings.profiler_pose or PoseSettings())
    pose = calibration.pose(*parameters[:6])
    lines = np.arange(-0.9 * radius, 0.9 * radius, settings.line_pitch)
    half = np.sqrt(radius**2 - lines**2)
    out = []
    for lift in settings.pocket_lifts:
        # Points on the rim and on the plate, as measured by a profiler at its nominal pose.
        plate = half + PLATE_DISTANCE
        for x, sigma, part in ((half, layout.edge, "rim"), (plate, settings.height_noise / 10, "plate")):
            sides = []
            for side in (-1, 1):
                point = np.stack([side * x, lines, np.zeros_like(x)], axis=-1)
                stage = np.stack([np.zeros_like(x), np.zeros_like(x), np.full_like(x, lift)], axis=-1)
                p = nominal.inv().apply(point - stage)
                along = p[:, 1] / (nominal.rotation.inv().apply([0.0, 1.0, 0.0])[1])
                stage[:, 1] += along
                p = nominal.inv().apply(point - stage)
                P = pose.apply(p) + stage
                sides.append(np.hypot(P[:, 0], P[:, 1]) - parameters[6] if part == "rim" else P[:, 2])
            left, right = sides
            # The jitter of a line in height is common to both sides of the plate.
            both = np.hypot(sigma / np.sqrt(2), layout.jitter_z if part == "plate" else 0.0)
            out += [(left + right) / 2 / both, (left - right) / np.sqrt(2) / sigma]
    return np.concatenate(out)
