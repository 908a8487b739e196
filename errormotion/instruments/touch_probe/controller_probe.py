"""A touch probe that a controller moves and reads: straight probing moves such as G38.2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from errormotion import plugins
from errormotion.datasets.units import Length, Time, Velocity
from errormotion.errors import InstrumentError, PluginError, code_of
from errormotion.instruments.driver import Openable
from errormotion.instruments.interlock import ArmedSettings, Interlock
from errormotion.instruments.touch_probe.probe import Probe, corrected, refuse_unmapped
from errormotion.instruments.touch_probe.settings import ProbeSettings
from errormotion.instruments.touch_probe.touching import (
    NO_TRIP,
    NOT_MADE,
    NOWHERE,
    TRIPPED,
    Strategy,
    StuckError,
    Toucher,
)
from errormotion.plugins import Contact, Identity, InstrumentInfo, InstrumentSubject, MachineLimits, Touch

_SAME = 1e-6  # m: shorter moves are not made, and controllers refuse to probe them


class ControllerProbeSettings(ArmedSettings, ProbeSettings):
    """Settings of a probe at a controller."""

    controller: str = Field(default="virtual_controller", description="plugin of the controller at the address")
    controller_settings: dict[str, Any] = Field(default_factory=dict, description="settings of that plugin")
    approach_feed: Velocity = Field(default=2.0 / 60, description="feed between touches", gt=0)
    search_feed: Velocity = Field(default=0.5 / 60, description="feed of the first contact", gt=0)
    touch_feed: Velocity = Field(default=0.03 / 60, description="feed of the slow contacts", gt=0)
    back_off: Length = Field(default=0.3e-3, description="distance of the retraction between two contacts", gt=0)
    repeats: int = Field(
        default=2, description="number of slow contacts of a touch; their mean is the result", ge=1, le=20
    )
    agreement: Length = Field(default=3e-6, description="largest difference of slow contacts", gt=0)
    free: Length = Field(default=0.2e-3, description="first part of a path, in which a trip counts as false", ge=0)
    margin: Length = Field(
        default=0.1e-3,
        description="largest distance between fast and slow contact, and from a contact to the path",
        gt=0,
    )
    clearance: Length = Field(
        default=30e-3, description="height above the starts of touches for moves between touches", ge=0
    )
    attempts: int = Field(default=1, description="number of retries after a false trip or a stuck probe", ge=0, le=9)
    settling: Time = Field(default=0.5, description="waiting time for a stuck probe", ge=0)

    @property
    def strategy(self) -> Strategy:
        """How a touch is made."""
        return Strategy(**{name: getattr(self, name) for name in Strategy.__dataclass_fields__})


class ControllerProbe(Probe, Openable):
    """A touch probe at a controller.

    Between touches the tip rises by the clearance, moves across and down; all these are probing moves, which stop on
    contact. After an error nothing moves; contacts made before it have been returned.

    Parameters
    ----------
    address : str
        URL of the controller; the probe opens its own connection.
    settings : ControllerProbeSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    last : Contact or None
        The last contact.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="controller_probe",
        kind="touch_probe",
        summary="Touch probe that a controller moves and reads, with slow repeats and detection of false triggers",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.controller.virtual:SimulatedController",
    )
    Settings: ClassVar[type[ControllerProbeSettings]] = ControllerProbeSettings
    settings: ControllerProbeSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        # Faults of the machine appear when it moves, not when it is read.
        harmless = ("split", "alarm", "estop", "no_trip", "tripped")
        return InstrumentSubject(cls, "sim://cframe/controller", harmless=harmless)

    def __init__(
        self, address: str, settings: ControllerProbeSettings | None = None, *, record: Path | None = None
    ) -> None:
        self.address = address
        self.settings = ControllerProbeSettings() if settings is None else settings
        self._record = record
        self._control: Any = None
        self._interlock = Interlock(self.info.id, address)

    # ------------------------------------------------------------------ opening and closing

    def open(self) -> None:
        """Connect to the controller and load the pre-travel map; idempotent.

        Raises
        ------
        InstrumentError
            No device answers, or the controller cannot probe.
        DatasetError
            The pre-travel map cannot be read.
        """
        if self._control is not None:
            return
        self._map = self.settings.pretravel_map()
        try:
            cls = plugins.get("instruments", self.settings.controller)
            armed = {"arm": self.settings.arm} if "arm" in cls.Settings.model_fields else {}
            settings = cls.Settings(**{**armed, **self.settings.controller_settings})
        except (PluginError, ValueError) as error:
            raise InstrumentError(
                f"The controller '{self.settings.controller}' of the probe: {error}",
                code=code_of(error, "probe.controller.settings"),
            ) from error
        if not hasattr(cls, "probe"):
            raise InstrumentError(
                f"The controller '{self.settings.controller}' cannot probe; choose one with probing moves",
                code="probe.controller.no_probing",
            )
        control = cls(self.address, settings, record=self._record)
        if hasattr(control, "bound"):
            control.bound(self._interlock.limits)
        control.open()
        self._control = control

    def close(self) -> None:
        """Disconnect; idempotent."""
        control, self._control = self._control, None
        if control is not None:
            control.close()

    @property
    def control(self) -> Any:
        """The controller, opened; InstrumentError before ``open``."""
        if self._control is None:
            raise InstrumentError(
                f"The controller_probe at {self.address} is not open: use it in a 'with' block, or call open() first",
                code="instrument.not_open",
            )
        return self._control

    # ------------------------------------------------------------------ state

    def identify(self) -> Identity:
        """Return the identity of the controller."""
        control: Identity = self.control.identify()
        return replace(
            control,
            model=f"{control.model} touch probe",
            details={**control.details, "controller": self.settings.controller, "tip_radius": self.tip_radius},
        )

    def bound(self, limits: MachineLimits) -> None:
        """Apply limits to every move from now on; the controller applies them to each command."""
        self._interlock.limits = limits
        if self._control is not None and hasattr(self._control, "bound"):
            self._control.bound(limits)

    def read(self) -> dict[str, Any]:
        """Return the position of the tip and the result of the last touch.

        ``position`` (m) and ``time`` (s), as the controller reports them; ``contacts``, the number of valid contacts
        since the driver was created; ``contact`` (m; NaN without one) and ``flag`` of the last touch.
        """
        state = self.control.state()
        return {
            "position": list(state["position"]),
            "time": float(state["time"]),
            "contacts": self._contacts,
            "contact": list(self.last.position if self.last else NOWHERE),
            "flag": self.last.flag if self.last else "",
        }

    # ------------------------------------------------------------------ touching

    def measure(self, touches: Sequence[Touch]) -> Iterator[Contact]:
        """Make touches one after another and yield the result of each, in order.

        A contact is the position of the tip when the probe tripped; with a pre-travel map, for touches along the
        normal, the position when the tip met the surface. After a touch without a contact the remaining touches of the
        item are ``not made``; after two such items in succession the probe is assumed to be defective. A probe that is
        tripped at the start, and remains so, yields a contact with its flag and then raises.

        Raises
        ------
        InstrumentError
            Touches from a direction that the pre-travel map does not cover, alarm, emergency stop, a lost connection,
            an obstacle, a probe that never trips or remains tripped. All motion has been stopped, unless the connection
            is lost.
        """
        touches = list(touches)
        self._interlock.require_armed(self.settings.arm, f"{len(touches)} touches")
        refuse_unmapped(self._map, touches)
        self._refuse_unfit()
        missed: list[int] = []  # items without a contact since the last contact
        for number, touch in enumerate(touches):
            if touch.item in missed:
                yield self._keep(Contact(NOWHERE, float(self.control.state()["time"]), NOT_MADE))
                continue
            try:
                contact = self._touch(touches, number)
            except InstrumentError as error:
                self._stop()
                what = f"Touch {number + 1} of {len(touches)} (item {touch.item}): {error}"
                if isinstance(error, StuckError):
                    yield self._keep(Contact(NOWHERE, self._time(), TRIPPED))
                raise error.restated(what) from error
            except BaseException:  # an interruption must not leave the machine moving
                self._stop()
                raise
            missed = [*missed, touch.item] if contact.flag == NO_TRIP else []
            yield self._keep(contact)
            if len(missed) > 1:
                self._stop()
                raise InstrumentError(
                    f"Touch {number + 1} of {len(touches)}: the probe did not trip on items {missed[0]} and "
                    f"{missed[1]} in succession. Check that it is connected and switched on. All motion has been "
                    "stopped",
                    code="probe.touches.missed",
                )
        if touches:
            self._leave(touches)

    def _touch(self, touches: Sequence[Touch], number: int) -> Contact:
        touch = touches[number]
        toucher = Toucher(self.control, self.settings.strategy)
        for position in self._path(touches, number):
            toucher.travel(position)
        contact = toucher.touch(touch)
        return corrected(self._map, touch, contact)

    def _path(self, touches: Sequence[Touch], number: int) -> list[Any]:
        """Return the positions of the path to the start of a touch: up, across, down.

        Within an item the tip rises above the starts of the item's touches, else above those of all touches.
        """
        here = np.array(self.control.state()["commanded_position"], dtype=float)
        start = np.array(touches[number].start, dtype=float)
        if np.abs(here - start).max() <= _SAME:
            return []
        before = touches[number - 1] if number else None
        within = before is not None and before.item == touches[number].item
        passed = [touch for touch in touches if not within or touch.item == touches[number].item]
        height = max(float(here[2]), max(touch.start[2] for touch in passed) + self.settings.clearance)
        positions = [np.array([*here[:2], height]), np.array([*start[:2], height]), start]
        return [
            each for each, last in zip(positions, [here, *positions], strict=False) if np.abs(each - last).max() > _SAME
        ]

    def _leave(self, touches: Sequence[Touch]) -> None:
        """Move up from the last touch."""
        here = np.array(self.control.state()["commanded_position"], dtype=float)
        height = max(touch.start[2] for touch in touches) + self.settings.clearance
        if here[2] < height - _SAME:
            Toucher(self.control, self.settings.strategy).travel(np.array([*here[:2], height]))

    def _refuse_unfit(self) -> None:
        state = self.control.state()
        alarms = "; ".join(state["alarms"])
        if state["estop"] or state["alarms"] or not state["enabled"] or state["homed"] is False:
            what = (
                "in emergency stop"
                if state["estop"]
                else f"in alarm: {alarms}"
                if alarms
                else "not homed"
                if state["homed"] is False
                else "not enabled"
            )
            raise InstrumentError(
                f"The machine at {self.address} is {what}; nothing was moved", code="machine.not_ready"
            )

    def _time(self) -> float:
        try:
            return float(self.control.state()["time"])
        except InstrumentError:
            return float("nan")

    def _stop(self) -> None:
        with suppress(InstrumentError):
            self.control.stop()
