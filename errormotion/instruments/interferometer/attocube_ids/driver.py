"""Driver of an attocube IDS3010."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from typing import ClassVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments import simulators
from errormotion.instruments.driver import Driver
from errormotion.instruments.interferometer.attocube_ids import codec
from errormotion.instruments.interferometer.attocube_ids.settings import IdsSettings, axis_name
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject
from errormotion.plugins.readings import Environment

IDLE, RUNNING = "system idle", "measurement running"
STARTING = ("measurement starting", "measurement restarting")
ALL_AXES = -1
"""Axis of the requests for the refraction index: the device accepts no other."""
POLL_INTERVAL = 0.2
"""Interval between two queries of the mode of the device, s."""
PASSES = ("single", "dual")
HECTOPASCAL = 100.0  # Pa

GOOD = ""


class AttocubeIds(Driver):
    """An attocube IDS3010, a fibre interferometer with three beams.

    Each axis is a channel, ``axis1`` to ``axis3``, with its displacement in m; two parallel beams form a channel of an
    angle. Before the first `zero`, readings are relative to the zero of the device. A beam that was broken has
    lost its count: its channels are NaN until the next `zero`, with the reason in ``flags``.

    Parameters
    ----------
    address : str
        ``tcp://192.168.1.1:9090``, ``sim://cframe/ids?seed=3``, ``replay://file``.
    settings : IdsSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    flags : dict of str to str
        Why the last reading of a channel has no value, by channel; empty if it has one.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="attocube_ids",
        kind="interferometer",
        summary="attocube IDS3010, a fibre interferometer with three beams, by JSON-RPC over TCP",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.interferometer.attocube_ids:SimulatedIds",
    )
    Settings: ClassVar[type[IdsSettings]] = IdsSettings
    settings: IdsSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(cls, "sim://cframe/ids?seed=3", vary=simulators.in_steps(seed=3))

    _number = 0
    _family = codec.FAMILIES[0]

    @property
    def channels(self) -> dict[str, str]:
        """Unit of each channel, ``m`` or ``rad``, by its name."""
        return {**{axis_name(axis): "m" for axis in self.settings.axes}, **dict.fromkeys(self.settings.angles, "rad")}

    # ------------------------------------------------------------------ requests

    def _call(self, method: str, *parameters: bool | int | str) -> codec.Reply:
        """Return the reply to one request, whatever its code; late replies to earlier requests are discarded."""
        result = self._reply(method, *parameters)
        if result.refusal:
            method = codec.in_family(method, self._family)
            raise InstrumentError(f"{self.address} refuses '{method}': {result.refusal}", code="instrument.refused")
        return result

    def _reply(self, method: str, *parameters: bool | int | str) -> codec.Reply:
        """Return the reply to one request, also one that states that it was not executed."""
        self._number += 1
        method = codec.in_family(method, self._family)

        def mine(text: bytes) -> codec.Reply | None:
            reply = codec.reply(text)
            return reply if reply.number == self._number or (reply.number is None and reply.refusal) else None

        with self.exchange() as line:
            line.write(codec.request(method, self._number, *parameters))
            return self.answer_line(line, f"'{method}'", mine, limit=codec.MAX_REPLY, within=self.settings.timeout)

    def _request(self, method: str, *parameters: bool | int | str) -> codec.Reply:
        """Return the reply to a request that must succeed."""
        result = self._call(method, *parameters)
        if result.code:
            raise InstrumentError(
                f"{self.address} refuses '{method}': {self._meaning(result.code)}", code="instrument.refused"
            )
        return result

    def _meaning(self, code: int) -> str:
        """Return number and text of an error, the text as the device states it."""
        with suppress(InstrumentError):
            return f"{code}, {self._call(codec.SERVICE + 'errorNumberToString', 1, code).text(0)}"
        return str(code)

    # ------------------------------------------------------------------ session

    def _start_session(self) -> None:
        self.flags: dict[str, str] = dict.fromkeys(self.channels, GOOD)
        self._zero = dict.fromkeys(self.settings.axes, 0.0)
        self._lost: dict[int, str] = {}  # reasons by axis, until the next zero
        model = self._device_type()
        if not model.startswith("IDS"):
            raise InstrumentError(
                f"{self.address}: expected an IDS3010; found '{model}'", code="instrument.model.unknown"
            )
        passes = self._passes()
        if self.settings.passes not in ("as_set", passes):
            raise InstrumentError(
                f"{self.address}: expected a device in {self.settings.passes} pass mode (setting 'passes'); it is in "
                f"{passes} pass mode",
                code="interferometer.passes.differ",
            )
        self._prepare()

    def _device_type(self) -> str:
        """Return the type of the device, in the first family of functions that it knows; use this one from now on."""
        refusals = []
        for self._family in codec.FAMILIES:
            reply = self._reply(codec.SYSTEM + "getDeviceType")
            if not reply.refusal:
                if reply.code:
                    raise InstrumentError(
                        f"{self.address} refuses its type: {self._meaning(reply.code)}", code="instrument.refused"
                    )
                return reply.text(0)
            refusals.append(f"'{codec.in_family(codec.SYSTEM, self._family)}getDeviceType': {reply.refusal}")
        raise InstrumentError(f"{self.address} refuses {'; '.join(refusals)}", code="instrument.refused")

    def _passes(self) -> str:
        mode = self._request(codec.AXIS + "getPassMode").quantity(0)
        return PASSES[int(mode)] if mode in (0.0, 1.0) else f"mode {mode:g}"

    def _prepare(self) -> None:
        """Set the averaging, and start the measurement if it is not running."""
        mode = self._mode()
        if mode not in (IDLE, *STARTING, RUNNING):
            raise InstrumentError(
                f"{self.address}: expected a device that measures or is idle; its mode is '{mode}'. End the alignment "
                "of the optics first",
                code="interferometer.mode.other",
            )
        if mode == IDLE:
            if not self.settings.start:
                raise InstrumentError(
                    f"{self.address} does not measure. Start the measurement at the device, or set 'start = true'",
                    code="interferometer.not_measuring",
                )
            self._start()
        elif mode in STARTING:
            self._await(RUNNING)
        if (parameter := self.settings.average_parameter) is not None:
            self._request(codec.DISPLACEMENT + "setAverageN", parameter)

    def _start(self) -> None:
        if self.settings.initialisation != "as_set":
            self._request(codec.SYSTEM + "setInitMode", int(self.settings.initialisation == "quick"))
        self._request(codec.SYSTEM + "startMeasurement")
        self._await(RUNNING)

    def _mode(self) -> str:
        return self._request(codec.SYSTEM + "getCurrentMode").text(0)

    def _await(self, goal: str) -> None:
        """Wait until the device is in a mode.

        Raises
        ------
        InstrumentError
            It reports an error, or takes longer than ``start_timeout``.
        """
        deadline = time.monotonic() + self.settings.start_timeout
        while (mode := self._mode()) != goal:
            if goal == RUNNING and mode == IDLE:
                code = self._call(codec.SYSTEM + "getSystemError").code
                raise InstrumentError(
                    f"{self.address} has not started to measure: {self._meaning(code)}. Check that beams are aligned",
                    code="interferometer.not_started",
                )
            if time.monotonic() > deadline:
                raise InstrumentTimeoutError(
                    f"{self.address}: expected the mode '{goal}' within {self.settings.start_timeout:g} s; found "
                    f"'{mode}'",
                    code="instrument.no_answer",
                )
            time.sleep(POLL_INTERVAL)

    def identify(self) -> Identity:
        """Return manufacturer, model, serial number, firmware and settings of the device."""
        average = self._request(codec.DISPLACEMENT + "getAverageN").quantity(0)
        return Identity(
            manufacturer="attocube",
            model=self._request(codec.SYSTEM + "getDeviceType").text(0),
            serial_number=self._request(codec.SERVICE + "getSerialNumber").text(0),
            firmware=self._request(codec.SERVICE + "getFirmwareVersion").text(0),
            simulated=self.transport.simulated,
            details={
                "address": self.address,
                "passes": self._passes(),
                "average_parameter": average,
                "air_compensation": self._has_unit(),
            },
        )

    def configure(self, settings: IdsSettings) -> None:
        """Use other settings from now on; newly selected axes are relative to the zero of the device until `zero`."""
        self.settings = settings
        self._zero = {axis: self._zero.get(axis, 0.0) for axis in settings.axes}
        self.flags = dict.fromkeys(self.channels, GOOD)
        self._prepare()

    # ------------------------------------------------------------------ measuring

    def read(self) -> dict[str, float]:
        """Return displacement (m) or angle (rad) of each channel since `zero`; NaN if a beam was broken since.

        Raises
        ------
        InstrumentError
            The device does not answer, or has stopped measuring.
        """
        found = self._displacements()
        lengths = {axis: found[axis] - self._zero[axis] for axis in self.settings.axes}
        values = {axis_name(axis): value for axis, value in lengths.items()}
        self.flags = {axis_name(axis): self._lost.get(axis, GOOD) for axis in self.settings.axes}
        for name, angle in self.settings.angles.items():
            values[name] = math.atan((lengths[angle.plus] - lengths[angle.minus]) / angle.base)
            self.flags[name] = self._lost.get(angle.plus, GOOD) or self._lost.get(angle.minus, GOOD)
        return values

    def _displacements(self) -> dict[int, float]:
        """Return the displacements that the device reports by axis, m; NaN for an axis that has lost its count."""
        values = self._call(codec.DISPLACEMENT + "getAxesDisplacement")
        if values.code == 0:
            counts = {axis: values.length(axis - 1) for axis in self.settings.axes}
        else:  # one warning applies to three axes, also to those that are not used
            counts = {axis: self._displacement(axis) for axis in self.settings.axes}
        return {axis: math.nan if axis in self._lost else count for axis, count in counts.items()}

    def _displacement(self, axis: int) -> float:
        values = self._call(codec.DISPLACEMENT + "getAxisDisplacement", axis - 1)
        if values.code == 0:
            return values.length(0)
        if (mode := self._mode()) != RUNNING:
            raise InstrumentError(
                f"{self.address} has stopped measuring; its mode is '{mode}'", code="interferometer.not_measuring"
            )
        if axis not in self._lost:
            self._lost[axis] = f"count lost: {self._meaning(values.code)}"
        return math.nan

    def zero(self) -> None:
        """Make readings relative to the present position.

        After a beam was broken, the measurement is first restarted or its error cleared (``after_break``).

        Raises
        ------
        InstrumentError
            A beam is broken, or the device does not answer.
        """
        if self._lost:
            if self.settings.after_break == "restart":
                self._request(codec.SYSTEM + "stopMeasurement")
                self._await(IDLE)
                self._start()
            else:
                self._request(codec.SYSTEM + "resetError", False)
            self._lost = {}
        found = self._displacements()
        if self._lost:
            broken = ", ".join(f"{axis_name(axis)} ({reason})" for axis, reason in self._lost.items())
            raise InstrumentError(
                f"{self.address}: the zero cannot be set while a beam is broken: {broken}. Align its reflector",
                code="interferometer.beam.broken",
            )
        self._zero = found

    # ------------------------------------------------------------------ air

    def environment(self) -> Environment:
        """Return the conditions of the air that the environmental unit measures; NaN without one."""
        if not self._has_unit():
            return Environment()
        return Environment(
            self._request(codec.UNIT + "getTemperatureInDegrees").quantity(0),
            self._request(codec.UNIT + "getPressureInHPa").quantity(0) * HECTOPASCAL,
            self._request(codec.UNIT + "getHumidityInPercent").quantity(0),
        )

    def refraction(self) -> float:
        """Return the refraction index with which the device computes lengths."""
        return self._request(codec.UNIT + "getRefractiveIndexForCompensation", ALL_AXES).quantity(0)

    def _has_unit(self) -> bool:
        """Whether an environmental unit is connected; the device reports this only while the unit is enabled."""
        return self._request(codec.UNIT + "getEnabled").flag(0) and self._request(codec.UNIT + "getConnected").flag(0)
