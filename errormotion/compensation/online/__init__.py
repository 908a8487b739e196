"""Online compensation: offsets that follow the temperatures of a machine.

`prediction.Predictor` is the interface of a model. `follower.Follower` decides which offset is written: a state machine
with limits, a slew limit, holding and ramping to zero. `audit.AuditLog` records every change. No module opens an
instrument. Import the modules individually, since a bench file requires `settings.Limits` alone.
"""
