"""Properties of the server and the tracker: values of the Get commands, in SI, in the order of the header."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from errormotion.instruments.simulators.laser_tracker.leica_emscon.status import Status

SERIAL = 390_000
MIN_DISTANCE = 0.5  # m
REFLECTORS = (("RRR 1.5in", 5, 19.05e-3), ("RRR 0.5in", 6, 6.35e-3), ("Cat's eye", 2, 0.0))
"""Name, target type and surface offset (m); their numbers count from 1."""


@dataclass(frozen=True)
class Model:
    """Number, name and longest distance (m) of a tracker, and its processor and distance meter."""

    kind: int
    name: str
    longest: float
    processor: int
    distance_meter: int


MODELS = {
    "AT901": Model(14, "AT901-MR", 80.0, 6, 2),
    "AT4xx": Model(72, "AT402", 160.0, 20, 3),
}


def identity(model: Model, version: tuple[int, int, int]) -> dict[str, list[Any]]:
    """Return the constant replies by the names of their commands."""
    text = ".".join(map(str, version))
    absolute = model.processor == MODELS["AT4xx"].processor
    compensation = [1, 1, "Factory", "", "Factory"]
    return {
        "GetTrackerInfo": [
            *(model.kind, model.name, SERIAL, 1, 1, 1, 1, 0.0, model.longest, MIN_DISTANCE),
            *(10 if absolute else 1000, 2, math.radians(360.0), math.radians(145.0), 1, 1, 0),
        ],
        "GetAT4xxInfo": [
            *(model.kind, model.name, SERIAL, 2, 0, 1, 1, 5, 0, *version, 0, 20, 500),
            *(MIN_DISTANCE, model.longest, 5e-6, 2.4e-6, 2.4e-6, 0.0),
        ],
        "GetMeteoStationInfo": [2, "AT MeteoStation", 1, 0],
        "GetSystemSoftwareVersion": [text],
        "GetTPInfo": [1, 0, 2, 0, 1, 0, model.processor, 20 if absolute else 2, 520, model.kind],
        "GetADMInfo": [1, 0, SERIAL],
        "GetADMInfo2": [model.distance_meter, "ADM", SERIAL, 1, 0, model.longest, MIN_DISTANCE, 10, 5e-6],
        "GetNivelInfo": [1, 0, SERIAL],
        "GetNivelInfo2": [3 if absolute else 2, "Nivel", SERIAL, 1, 0, 1.5e-3, 1e-6, 0.0],
        "GetATRInfo": [2, "ATR", 1, 0, 0, 1, 0, 1, model.longest, MIN_DISTANCE, math.radians(1.2), 0.0],
        "GetOverviewCameraInfo": [20 if absolute else 1, "Overview", 1, 0.0255, 0.0048, 0.0036, 0, 0],
        "GetCompensation": [1],
        "GetCompensations": [*compensation, 0],
        "GetCompensations2": [*compensation, "", 0, 1],
        "GetTrackerDiagnostics": [*([0.0] * 9), 1.0, 0, 25.0, 1000, 1000],
        "GetCamera": [0, 0],
    }


ABSENT: Mapping[str, Status] = {
    **dict.fromkeys(
        (
            *("GetCameras", "SetMeasurementCameraMode", "GetMeasurementCameraMode", "GetMeasurementCameraInfo"),
            *("GetTCamToTrackerCompensations", "GetTCamToTrackerCompensation", "SetTCamToTrackerCompensation"),
        ),
        Status.NO_MEASUREMENT_CAMERA,
    ),
    **dict.fromkeys(
        (
            *("GetProbes", "GetProbe", "GetMeasurementProbeInfo"),
            *("GetProbeCompensations", "GetProbeCompensation", "SetProbeCompensation"),
        ),
        Status.NO_PROBE,
    ),
    **dict.fromkeys(
        (
            *("GetTipAdapters", "GetTipAdapter", "SetTipAdapter", "GetTipToProbeCompensations"),
            *("GetTipToProbeCompensations2", "GetTipToProbeCompensation"),
        ),
        Status.NO_TIP,
    ),
    "GetTriggerBoardInfo": Status.NO_TRIGGER_BOARD,
    "GetStillImage": Status.NO_VIDEO_CAMERA,
    **dict.fromkeys(
        (
            *("CallTransformation", "GetTransformedPoints", "CallIntermediateCompensation"),
            *("ConvertDisplayCoordinates", "GetErrorEllipsoid"),
        ),
        Status.NOT_IMPLEMENTED,
    ),
}
"""Commands of parts that this tracker does not have, and of calculations that the simulator does not perform."""
IDLE = frozenset({
    *("ExitApplication", "ReleaseMotors", "SwitchLaser", "Park", "ClearCommandQueue"),
    *("ClearTransformationNominalPointList", "ClearTransformationActualPointList", "AddTransformationNominalPoint"),
    *("AddTransformationActualPoint", "ClearDrivePointList", "AddDrivePoint"),
})  # fmt: skip
"""Commands that are accepted and do not affect measurements."""
