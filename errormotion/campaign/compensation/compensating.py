"""Compensation of a machine in operation: readings, prediction, offset, repeated in each period.

The bench is read and logged as by a monitor, into a run folder with an audit log of every change. Unless the machine
is armed (``arm``), the offsets are only computed and logged, and nothing is written.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.campaign.claims import claimed, uses
from errormotion.campaign.compensation.following import AUDIT, STOP, Status, is_zero, numbers, write_status
from errormotion.campaign.files import BenchPlan
from errormotion.campaign.monitor.clock import Clock
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.campaign.storage.journal import cause_of
from errormotion.compensation.online.audit import AuditLog
from errormotion.compensation.online.follower import Conditions, Follower, State, Step
from errormotion.compensation.online.prediction import PARAMETERS, Prediction, predictor, refusal
from errormotion.compensation.online.settings import Limits
from errormotion.datasets import provenance
from errormotion.datasets.clock import age
from errormotion.errors import BenchError, CompensationError, InstrumentError

FRAME = "machine"
"""Frame in which a model must state its errors: offsets are along the axes."""

TEST = "compensation"
MAX_TEXT = 500
"""Longest text in the state, characters."""

READINGS_TO_REJOIN = 3
"""Consecutive readings of the offset after which a lost connection counts as restored."""

AGREEMENT = 3.0
"""Largest difference between the offset in effect and the written one, in multiples of slew limit times period."""

CONFIRMATIONS = 10
"""Number of readings after the last offset within which the machine should report an offset of zero."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Moment:
    """One decision of a compensation.

    Attributes
    ----------
    snapshot : Snapshot
        Readings of the instruments.
    prediction : Prediction
    step : Step
        State, offset and cause.
    applied : tuple of float or None
        Offset in effect as the machine reports it, m; None if it is not read.
    """

    snapshot: Snapshot
    prediction: Prediction
    step: Step
    applied: tuple[float, float, float] | None = None


class Compensation:
    """Compensates a machine by offsets that follow its temperatures; a context manager.

    Parameters
    ----------
    plan : BenchPlan
        Its thermometers and its controller are read; its compensator writes the offsets.
    model : Dataset
        A model that predicts errors from readings.
    runs : Path
        Folder of the run folder.
    arm : str, optional
        Name of the machine, which must be that of the bench. Without it nothing is written.
    functional_point : (3,), optional
        Point at which the errors are compensated, m, in the frame of the model; default: that of the model.
    since : Dataset, optional
        Log of a monitor or of an earlier compensation, whose first row is the reference state; default: the first
        readings are the reference state. Between the log and now temperatures are interpolated linearly.
    clock : Clock, optional
        Clock; default: that of the computer.

    Attributes
    ----------
    folder : RunFolder
        The run folder, once entered.
    armed : bool
        Whether offsets are written.
    note : str
        Which other programs may not see that this one uses the instruments, or are not refused; empty if there are
        none.

    Raises
    ------
    CompensationError
        ``arm`` is not the machine of the bench, the bench has no compensator, or the model does not fit the bench.
    """

    def __init__(
        self,
        plan: BenchPlan,
        model: xr.Dataset,
        runs: Path,
        *,
        arm: str | None = None,
        functional_point: Array | None = None,
        since: xr.Dataset | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.plan, self.armed = plan, arm is not None
        self.limits = plan.compensator.limits if plan.compensator else Limits()
        self._check(model, arm)
        self._predictor = predictor(model, functional_point)
        self._model_hash = provenance.hash_dataset(model)
        self._monitor = Monitor(plan, runs, self.limits.period, clock, TEST)
        self._check_inputs()
        self._gap = 0.0 if since is None else self._replay(since)
        self._follower = Follower(self.limits)
        self._output: Any = None
        self._regained = 0
        self._lost = False
        self._known: dict[str, tuple[float, float]] = {}
        self._last: tuple[State, str, tuple[float, ...]] | None = None
        self._status: Status | None = None
        self._stack = ExitStack()
        self.note = ""

    def _check(self, model: xr.Dataset, arm: str | None) -> None:
        machine, frame = str(model.attrs.get("machine", "unknown")), str(model.attrs.get("frame", "unknown"))
        if arm is not None and arm != self.plan.machine:
            raise CompensationError(
                f"--arm {arm}: the machine of {self.plan.source} is '{self.plan.machine}'. Nothing was written.",
                code="compensation.arm.other_machine",
            )
        if arm is not None and self.plan.compensator is None:
            raise CompensationError(
                f"{self.plan.source}: expected a table [compensator] to write offsets; found none.",
                code="compensation.compensator.missing",
            )
        if machine != self.plan.machine:
            raise CompensationError(
                f"The model is for the machine '{machine}'; the machine of the bench is '{self.plan.machine}'.",
                code="compensation.machine.other",
            )
        if frame != FRAME:
            raise CompensationError(
                f"The model states errors in the frame '{frame}'; offsets need the frame '{FRAME}'.",
                code="compensation.frame.other",
            )

    def _check_inputs(self) -> None:
        absent = [name for name in self._predictor.temperatures if name not in self._monitor.sensors]
        if absent:
            names = ", ".join(self._monitor.sensors) or "none"
            raise BenchError(
                f"{self.plan.source}: the model needs the temperatures {', '.join(absent)}; found {names}",
                code="bench.temperatures.missing",
            )
        if (needed := self._predictor.parameters) and self._monitor.controller is None:
            raise BenchError(
                f"{self.plan.source}: the model needs {', '.join(needed)}; found no controller",
                code="bench.controller.missing",
            )

    def _replay(self, earlier: xr.Dataset) -> float:
        """Update the predictor with the readings of a log; return the time since its last row, s."""
        passed = age(earlier)
        if math.isnan(passed):
            raise CompensationError(
                "The time since the earlier readings is unknown, because the clocks of their log and of this computer "
                "contradict each other. Start on a cold machine, without --since.",
                code="compensation.clock.unknown",
            )
        times = np.asarray(earlier["time"].values, dtype=float) - passed
        if not times.size or not times[-1] < 0:
            raise CompensationError(
                "The log of the earlier readings ends in the future: its clock or that of this computer is wrong.",
                code="compensation.clock.future",
            )
        names = [str(name) for name in earlier["sensor"].values]
        temperature = np.asarray(earlier["temperature"].transpose("time", "sensor").values, dtype=float)
        speeds = {name: np.asarray(earlier[name].values, dtype=float) for name in PARAMETERS if name in earlier}
        for k, at in enumerate(times):
            row = dict(zip(names, map(float, temperature[k]), strict=True))
            self._predictor.update(float(at), row, {name: float(values[k]) for name, values in speeds.items()})
        return -float(times[-1])

    @property
    def folder(self) -> Any:
        """The run folder."""
        return self._monitor.folder

    @property
    def state(self) -> State:
        """Present state."""
        return self._follower.state

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            what = "an armed compensation" if self.armed else "a compensation in shadow mode"
            held = stack.enter_context(claimed(uses(self.plan, "follow", offsets=self.armed), what))
            self.note = held.note
            if self.plan.compensator is not None:
                each = self.plan.compensator
                self._output = each.driver(each.address, each.settings)
                self._output.open()
                stack.callback(self._close)
                if self.armed:
                    self.note = " ".join(filter(None, (self.note, getattr(self._output, "note", ""))))
            stack.enter_context(self._monitor)
            held.records(self.folder.path)
            self._audit = stack.enter_context(AuditLog(self.folder.path / AUDIT))
            self._begin()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        last = self._status
        with suppress(CompensationError):
            applied = last.applied if last is not None else None
            ended = {"state": str(self.state), "offset": numbers(self._follower.offset), "applied": applied}
            self._audit.write({"event": "ended", **ended}, last=True)
        if last is not None:
            self._show(last.model_copy(update={"ended": True, "time": datetime.now(UTC), "state": str(self.state)}))
        self._stack.__exit__(kind, error, trace)

    def _begin(self) -> None:
        identity = provenance.plain(self._output.identify()) if self._output is not None else None
        self._audit.write(
            {
                "event": "armed" if self.armed else "shadow",
                "machine": self.plan.machine,
                "bench": hashlib.sha256(self.plan.text.encode()).hexdigest(),
                "model": self._model_hash,
                "limits": self.limits.model_dump(),
                "compensator": identity,
                "since_last_reading": self._gap,
            },
            sync=True,
        )
        self.folder.data["compensation"] = {"armed": self.armed, "model": self._model_hash, "audit": AUDIT}
        self.folder.save()
        applied = np.zeros(3)
        if self.armed:
            self._output.arm(self.limits.limit)
            applied = np.asarray(self._output.read().offset)
        self._follower.arm(applied)

    def stop(self) -> None:
        """Ramp to zero, then end `follow`.

        The iteration ends when the machine reports an offset of zero, or after `CONFIRMATIONS` readings. Without a
        connection it ends after the time ``hold``; the watchdog of the machine ramps to zero.
        """
        self._follower.stop()

    def follow(self, duration: float = math.inf) -> Iterator[Moment]:
        """Read, predict and write in each period; yield each decision.

        Parameters
        ----------
        duration : float
            Duration, s; then the offset ramps to zero, and the iteration ends.

        Raises
        ------
        CompensationError, RunError
            The audit log or the log of readings cannot be written. Nothing further is written to the machine, whose
            watchdog then ramps to zero.
        """
        able = 0.0  # last time at which the machine accepted offsets, or at which no stop was requested
        readings = 0  # since the last offset was written
        for snapshot in self._monitor.watch():
            if snapshot.time >= duration or (self.folder.path / STOP).exists():
                self.stop()
            moment = self._moment(snapshot)
            yield moment
            stuck = self._follower.stopping and self.state is State.FAULT
            able = able if stuck else snapshot.time
            if stuck and snapshot.time - able >= self.limits.hold:
                return
            if self.state is State.OFF:
                zero = readings > 0 and moment.applied is not None and is_zero(moment.applied)
                if not self.armed or zero or readings == CONFIRMATIONS:
                    return
                readings += 1

    def _moment(self, snapshot: Snapshot) -> Moment:
        prediction, cause = self._predict(snapshot)
        applied, busy, fault = self._read()
        if self.state is State.FAULT and not fault:
            self._rejoin(applied)
        target, before = None if cause else -prediction.errors[:3], self.state
        step = self._follower.step(snapshot.time, Conditions(target, cause, busy, fault))
        self._record(snapshot, prediction, step, applied)  # before anything is written
        if self.armed and before not in (State.OFF, State.FAULT) and step.state is not State.FAULT:
            self._write(step)
        moment = Moment(snapshot, prediction, step, applied)
        self._show(self._stated(moment))
        return moment

    def _predict(self, snapshot: Snapshot) -> tuple[Prediction, str]:
        """Return the prediction, and why it must not be used."""
        readings = {**snapshot.temperatures, **_parameters(snapshot.state)}
        for name, value in readings.items():
            if math.isfinite(value):
                self._known[name] = snapshot.time, value
        recent = {
            name: value
            for name, (at, value) in self._known.items()
            if snapshot.time - at <= self.limits.oldest and name not in snapshot.doubtful
        }
        prediction = self._predictor.update(snapshot.time, recent, recent)
        doubtful = self._doubtful(snapshot)
        if doubtful:
            return prediction, "; ".join(f"{name} {why}" for name, why in doubtful.items())
        return prediction, refusal(prediction, self.limits)

    def _doubtful(self, snapshot: Snapshot) -> dict[str, str]:
        """Return the inputs of the model whose sensors no longer measure, and why."""
        return {name: why for name, why in snapshot.doubtful.items() if name in self._predictor.temperatures}

    def _read(self) -> tuple[tuple[float, float, float] | None, str, str]:
        """Return the offset in effect, why it must not change, and why the machine accepts none."""
        if self._output is None:
            return None, "", ""
        try:
            self._output.open()
            applied = self._output.read()
        except InstrumentError as error:
            self._lost, self._regained = True, 0
            return None, "", f"no answer: {cause_of(error)}" if self.armed else ""
        offset = (float(applied.offset[0]), float(applied.offset[1]), float(applied.offset[2]))
        if not self.armed or applied.fault:
            return offset, applied.busy, applied.fault if self.armed else ""
        if self.state in (State.OFF, State.FAULT) or self._lost:
            return offset, applied.busy, ""
        allowed = AGREEMENT * self.limits.slew * self.limits.period
        if not (np.abs(self._follower.offset - offset) <= allowed).all():
            return (
                offset,
                applied.busy,
                "the offset of the machine is not the written one: another program wrote it, or the machine stopped",
            )
        return offset, applied.busy, ""

    def _rejoin(self, applied: tuple[float, float, float] | None) -> None:
        """After a lost connection, continue from the present offset of the machine; other faults need the operator."""
        self._regained += 1
        if self._lost and applied is not None and self._regained >= READINGS_TO_REJOIN:
            with suppress(CompensationError):
                self._follower.arm(np.asarray(applied))
                self._lost = False

    def _write(self, step: Step) -> None:
        try:
            self._output.write([float(x) for x in step.offset])
        except InstrumentError as error:
            self._lost, self._regained = True, 0
            log.warning("the offset was not written: %s", cause_of(error))
            self._follower.fail()

    def _record(
        self, snapshot: Snapshot, prediction: Prediction, step: Step, applied: tuple[float, float, float] | None
    ) -> None:
        now = step.state, step.cause, tuple(map(float, step.offset))
        if now == self._last:
            return
        changed = self._last is None or now[:2] != self._last[:2]
        self._last = now
        names = (*self._predictor.temperatures, *self._predictor.parameters)
        known = {name: self._known[name][1] for name in names if name in self._known}
        self._audit.write(
            {
                "elapsed": snapshot.time,
                "state": str(step.state),
                "offset": numbers(step.offset),
                "applied": None if applied is None else numbers(applied),
                "target": numbers(-prediction.errors[:3]),
                "uncertainty": numbers(prediction.uncertainty[:3]),
                "cause": step.cause,
                "limited": ["XYZ"[k] for k in step.limited],
                "inputs": known,
            },
            sync=changed,
        )
        if changed:
            log.info("%s%s", step.state, f": {step.cause}" if step.cause else "")

    def _stated(self, moment: Moment) -> Status:
        step, prediction, state = moment.step, moment.prediction, moment.snapshot.state
        names = (*self._predictor.temperatures, *self._predictor.parameters)
        estop = state.get("estop")
        return Status(
            time=datetime.now(UTC),
            machine=self.plan.machine[:MAX_TEXT],
            bench=self.plan.source.name[:MAX_TEXT],
            compensator=self.plan.compensator.driver.info.id if self.plan.compensator is not None else "",
            armed=self.armed,
            limits=self.limits,
            state=str(self.state),
            cause=step.cause[:MAX_TEXT],
            stopping=self._follower.stopping,
            elapsed=moment.snapshot.time,
            offset=numbers(step.offset),
            applied=None if moment.applied is None else numbers(moment.applied),
            predicted=numbers(prediction.errors),
            uncertainty=numbers(prediction.uncertainty),
            inputs={name: each for name in names for each in numbers([self._known.get(name, (0.0, math.nan))[1]])},
            missing=tuple(name for name in prediction.missing if name not in moment.snapshot.doubtful),
            doubtful=tuple(self._doubtful(moment.snapshot)),
            outside=tuple(prediction.outside),
            limited=tuple("XYZ"[k] for k in step.limited),
            estop=estop if isinstance(estop, bool) else None,
            program=str(state.get("program") or "")[:MAX_TEXT],
        )

    def _show(self, status: Status) -> None:
        self._status = status
        with suppress(OSError):  # only the audit log is mandatory
            write_status(self.folder.path, status)

    def _close(self) -> None:
        with suppress(InstrumentError):
            self._output.close()


def _parameters(state: Mapping[str, Any]) -> dict[str, float]:
    values = {name: state.get(name) for name in PARAMETERS}
    return {name: math.nan if value is None else float(value) for name, value in values.items()}
