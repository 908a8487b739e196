"""Online compensation: offsets that follow the temperatures of a machine.

`Predictor` evaluates a thermal model reading by reading. `Follower` decides what may be written: a state machine with
limits, a slew limit, holding and ramping to zero. `AuditLog` records every change. Nothing here opens an instrument.
"""

from errormotion.compensation.online.audit import AuditLog, verify
from errormotion.compensation.online.follower import Conditions, Follower, State, Step
from errormotion.compensation.online.predictor import Prediction, Predictor
from errormotion.compensation.online.settings import Limits

__all__ = ["AuditLog", "Conditions", "Follower", "Limits", "Prediction", "Predictor", "State", "Step", "verify"]
