"""The pose of the profiler as an error dataset: the errors against the nominal pose, and the pose itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy.spatial.transform import RigidTransform

from errormotion.datasets import build_errors, provenance
from errormotion.datasets.timing import start_of
from errormotion.kinematics.poses import displacement
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.plugins import RandomSource, TrialModel

if TYPE_CHECKING:
    from numpy.random import Generator

    from errormotion.arrays import Array
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings, PoseSettings

RADIUS_UNCERTAINTY = 1e-6
"""Standard uncertainty of the radius of a pocket, m, where the data state none."""
NOMINAL_STEP = 0.01
"""Without a stated nominal pose, the nominal position is the one found, rounded to this, m; its angles are 0."""


def stated_pose(pose: PoseSettings) -> RigidTransform:
    """Return the pose that settings state."""
    return calibration.pose(pose.a, pose.b, pose.g, pose.dx, pose.dy, pose.dz)


def stated_covariance(pose: PoseSettings) -> np.ndarray:
    """Return the covariance (6, 6) of (a, b, g, dx, dy, dz) that settings state."""
    return np.diag([pose.angle_uncertainty] * 3 + [pose.place_uncertainty] * 3) ** 2


def identify_pose(raw: xr.Dataset, settings: CrossbeamScanSettings, method: str, version: str) -> xr.Dataset:
    """Return the pose of the profiler from scans of a pocket: variant "profiler pose" of the raw dataset.

    The errors are those of one beam, ``profiler``: actual minus nominal pose in the tool frame, at the nominal origin.
    Extras: ``profiler_pose`` (row, column), ``pose_covariance`` (p, p_) over (a, b, g, dx, dy, dz), ``nominal_pose``.

    Raises
    ------
    MethodError
        As for `calibration.calibrate`.
    """
    pose = calibration.calibrate_dataset(raw, angle_prior=settings.angle_prior)
    H = pose.transform
    nominal = (
        stated_pose(settings.profiler_pose)
        if settings.profiler_pose is not None
        else RigidTransform.from_translation(NOMINAL_STEP * np.round(H.translation / NOMINAL_STEP))
    )
    point = np.asarray(nominal.translation)
    J = _sensitivity(calibration.parameters(H), nominal)
    square = (("row", "column"), ("p", "p_"))
    return build_errors(
        _deviation(H, nominal)[None],
        (J.T @ pose.covariance @ J)[None],
        dims=("beam",),
        coords={"beam": ["profiler"]},
        component="beam",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame="tool",
        functional_point=point,
        reference="nominal pose of the profiler",
        method=method,
        method_version=version,
        measured=raw.attrs,
        start=start_of(raw),
        provenance=provenance.make(settings, raw, None, steps=["edges of the pocket", "fit pose"]),
        extras={
            "profiler_pose": xr.DataArray(pose.matrix, dims=square[0]),
            "nominal_pose": xr.DataArray(nominal.as_matrix(), dims=square[0]),
            "pose_covariance": xr.DataArray(pose.covariance, dims=square[1]),
            "pocket_radius_found": xr.DataArray(pose.radius, attrs={"units": "m"}),
            "edge_scatter": xr.DataArray(
                [pose.residual_x, pose.residual_y],
                dims="edge_direction",
                coords={"edge_direction": ["x", "y"]},
                attrs={"units": "m"},
            ),
        },
    ).assign_attrs(notes=[""], lines_used=pose.lines)


def _deviation(pose: RigidTransform, nominal: RigidTransform) -> np.ndarray:
    """Return the twist (..., 6) from the nominal pose to another, at the nominal position."""
    return displacement(pose * nominal.inv(), nominal.translation)


def _sensitivity(p: np.ndarray, nominal: RigidTransform) -> np.ndarray:
    """Return the derivative of that twist with respect to each parameter of the pose, (parameter, 6).

    `chain.pose_twists` is not accurate enough: a deviation of some milliradians from the nominal pose rotates the
    rotation vector, so that an angle known to 20 urad affects one that is known to 0.1 urad.
    """
    steps = 1e-6 * np.eye(6)
    up, down = (_deviation(calibration.pose(*ends.T), nominal) for ends in (p + steps, p - steps))
    return np.asarray((up - down) / 2e-6)


def trial_model(raw: xr.Dataset, settings: CrossbeamScanSettings) -> TrialModel:
    """Return the scans of a pocket with their sources for the Monte Carlo method: lines, radius and centre.

    The scans state no noise. Their lines are drawn with replacement, which reproduces their scatter.
    """
    radius = float(raw["pocket_radius_uncertainty"]) if "pocket_radius_uncertainty" in raw else RADIUS_UNCERTAINTY
    sources = {"lines": RandomSource(_lines, own=True), "radius of the pocket": _shift("pocket_radius", radius)}
    if "pocket_centre_uncertainty" in raw:
        centre = np.asarray(raw["pocket_centre_uncertainty"].values, dtype=float)
        sources["centre of the pocket"] = _shift("pocket_centre", centre)
    return TrialModel(raw.load(), settings, sources)


def _lines(
    raw: xr.Dataset, settings: CrossbeamScanSettings, generator: Generator
) -> tuple[xr.Dataset, CrossbeamScanSettings]:
    """Return every scan with the same number of its lines, drawn with replacement."""
    scans = []
    for number in range(raw.sizes["scan"]):
        drawn = np.sort(generator.integers(0, raw.sizes["profile"], raw.sizes["profile"]))
        scans.append(raw[["height", "stage"]].isel(scan=number, profile=drawn))
    chosen = xr.concat(scans, "scan")
    return raw.assign({name: chosen[name].transpose(*raw[name].dims) for name in ("height", "stage")}), settings


def _shift(name: str, uncertainty: Array | float) -> RandomSource:
    def draw(
        raw: xr.Dataset, settings: CrossbeamScanSettings, generator: Generator
    ) -> tuple[xr.Dataset, CrossbeamScanSettings]:
        value = raw[name]
        change = uncertainty * generator.normal(size=value.shape)
        return raw.assign({name: value.copy(data=value.values + change)}), settings

    return RandomSource(draw, own=True)
