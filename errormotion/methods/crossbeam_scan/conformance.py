"""Simulated campaigns with which the conformance kit examines the method."""

from __future__ import annotations

from functools import partial

from errormotion.measurement import ModelMethod
from errormotion.methods.crossbeam_scan.method import CrossbeamScan
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.methods.crossbeam_scan.simulation import POSITIONS, simulate
from errormotion.plugins import MethodSubject

NOMINAL_LIFT = -0.17
"""Nominal height of the profiler in the tool frame, m."""


def subjects() -> tuple[MethodSubject, ...]:
    """Return a cold and a warm scan of three artefacts, the pose of the profiler, and registrations.

    The first two have an eighth of the points of a real profiler, those of the scans at twice their distance. The axis
    is Y of every frame: the frame of the scans is turned about Y, those of the others not at all.
    """
    small = {"scan_length": 28e-3, "line_pitch": 140e-6, "layout": {"points": 800, "width": 20e-3}}
    scan = {"positions": POSITIONS, "warm_up": (7200.0,)}
    pose = {"procedure": "profiler_pose", "profiler_pose": {"dz": NOMINAL_LIFT}}
    registered = {"positions": POSITIONS, "warm_up": (1800.0, 7200.0), "profiler_pose": {"dz": NOMINAL_LIFT}}
    coarse = {"line_pitch": 140e-6, "layout": {"points": 800, "width": 40e-3}}
    return (
        MethodSubject(
            CrossbeamScan,
            partial(simulate, CrossbeamScanSettings.model_validate(scan | small)),
            name="scan",
            settings={"positions": POSITIONS},
            raw_vectors={"profiler_pose": "pose", "lever": "direction"},
            optional=("lever_uncertainty",),
            measured=("height",),
            motion=((0.0, 0.3, 0.0), (0.0, 0.0, 0.0)),
            seeds=40,
        ),
        MethodSubject(
            CrossbeamScan,
            partial(simulate, CrossbeamScanSettings.model_validate(pose | coarse)),
            name="profiler_pose",
            settings=pose,
            raw_vectors={},
            optional=("pocket_radius_uncertainty",),
            measured=("height",),
            motion=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
            seeds=40,
        ),
        MethodSubject(
            CrossbeamScan,
            partial(ModelMethod.simulate, CrossbeamScan(), CrossbeamScanSettings.model_validate(registered)),
            name="registrations",
            settings=registered,
            raw_vectors={"profiler_pose": "pose", "lever": "direction"},
            optional=("lever_uncertainty", "pose_covariance", "strain_effect"),
            measured=("displacement", "rotation"),
            motion=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),  # the covariance of the pose is that of angles about axes
        ),
    )
