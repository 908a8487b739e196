"""Online compensation: offsets that follow the temperatures of a machine.

`prediction.Predictor` is what a model must offer. `follower.Follower` decides what may be written: a
state machine with limits, a slew limit, holding and ramping to zero. `audit.AuditLog` records every change. Nothing
here opens an instrument. The modules are imported one by one, since a bench file needs `settings.Limits` alone.
"""
