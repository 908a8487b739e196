"""The commands and the state of an LJ-X8000A.

Commands and layouts are those of the manufacturer's Linux library (LJX8_IF_Linux 1.0.0), return codes those of the
manufacturer's sample application for LJ-X8000A. What neither shows is listed on the device's page as assumed.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from functools import partial

from errormotion.instruments.simulators.line_profiler import keyence_ljx_settings as settings
from errormotion.instruments.simulators.line_profiler import keyence_ljx_wire as wire
from errormotion.instruments.simulators.line_profiler.keyence_ljx_fetching import batch_profiles, single_profiles
from errormotion.instruments.simulators.line_profiler.keyence_ljx_measuring import Measuring
from errormotion.instruments.simulators.line_profiler.keyence_ljx_wire import Answer, Code, ProfileLayout
from errormotion.instruments.simulators.line_profiler.profile_sources import FreeRunning

SET_SETTING = 0x32  # the only command with a variable length
SAVING = 0.02  # s for which the save area is busy after saving
TEMPERATURES = (3512, 4108, 2967)  # hundredths of a degC


class Controller:
    """The commands of a controller.

    Parameters
    ----------
    measuring : Measuring
    connected : callable
        Returns whether the stream has a connection.
    serial : str
        Of the controller.
    points, kind : int
        Of a profile.
    x_pitch : int
        Unit 0.01 um.
    delivered : dict
        Settings of a program as delivered.

    Attributes
    ----------
    errors : list of int
        Active system errors.
    restarts : bool
        Whether it restarts after the answer.
    """

    def __init__(
        self,
        measuring: Measuring,
        connected: Callable[[], bool],
        *,
        serial: str,
        points: int,
        kind: int,
        x_pitch: int,
        delivered: dict[tuple[int, int], bytes],
    ) -> None:
        self.restarts = False
        self.errors: list[int] = []
        self._measuring, self._connected = measuring, connected
        self._serial, self._points, self._kind, self._x_pitch = serial, points, kind, x_pitch
        self._settings = settings.SettingLevels(delivered)
        self._program = self._timer = 0
        self._prepared: tuple[ProfileLayout, int] | None = None
        self._cleared_since = False
        self._starts = 0
        self._saved_at = -1.0
        self._commands = self._table()

    @property
    def layout(self) -> ProfileLayout:
        """Layout of the profiles of a stream with the present settings."""
        pitch = self._x_pitch * wire.LENGTH
        return ProfileLayout(0x5A00 + self._starts, self._kind, self._points, 1e-7, -(self._points // 2) * pitch, pitch)

    def restart(self) -> None:
        """Restart with the saved settings."""
        self.restarts = False
        self._measuring.reset()
        self._settings.restart()
        self._program, self._prepared, self.errors = 0, None, []

    def answer(self, request: bytes, execute: Callable[[int, bytes], Answer]) -> bytes:
        """Return the answer to one request; ``execute`` is `execute` or a wrapper of it."""
        opcode = request[16] if len(request) > 16 else 0
        code: int
        if request[4:8] != wire.PREFIX:
            code, data = (Code.OTHER_MODEL if request[5:8] == wire.PREFIX[1:] else Code.WRONG_LENGTH), b""
        elif len(request) < 20 or struct.unpack_from("<I", request, 12)[0] != len(request) - 16:
            code, data = Code.WRONG_LENGTH, b""
        else:
            code, data = execute(opcode, request[20:])
        return wire.reply(opcode, code, self._program, data)

    def execute(self, opcode: int, arguments: bytes) -> Answer:
        """Execute a command; return code and data of its answer."""
        if opcode not in self._commands:
            return Code.UNKNOWN, b""
        length, command = self._commands[opcode]
        fits = len(arguments) > length if opcode == SET_SETTING else len(arguments) == length
        return command(arguments) if fits else (Code.WRONG_LENGTH, b"")

    def _table(self) -> dict[int, tuple[int, Callable[[bytes], Answer]]]:
        """Return the commands: length of the arguments in bytes, and the function."""
        return {
            0x02: (0, self._reboot),
            0x03: (0, self._reset),
            0x04: (0, lambda _: (Code.OK, struct.pack(f"<B3x{len(self.errors)}H", len(self.errors), *self.errors))),
            0x05: (4, self._clear_error),
            0x06: (0, lambda _: (Code.OK, self._units())),
            0x21: (0, self._trigger),
            0x22: (0, self._start_batch),
            0x23: (0, self._stop_batch),
            0x27: (0, self._clear_memory),
            0x2A: (4, self._control_laser),
            0x2B: (0, lambda _: (Code.OK, b"")),
            0x31: (16, self._get_setting),
            SET_SETTING: (12, self._set_setting),
            0x33: (4, partial(self._reflect, True)),
            0x34: (0, lambda _: (Code.OK, struct.pack("<B3x", self._saving))),
            0x35: (4, partial(self._reflect, False)),
            0x36: (4, self._set_x_pitch),
            0x37: (0, lambda _: (Code.OK, struct.pack("<I", self._x_pitch))),
            0x39: (4, self._change_program),
            0x3D: (8, self._initialise),
            0x42: (16, self._get_profile),
            0x43: (20, self._get_batch_profile),
            0x47: (4, self._prepare),
            0x48: (0, self._stop_stream),
            0x4B: (0, self._counts),
            0x4C: (0, lambda _: (Code.OK, struct.pack("<3hxx", *TEMPERATURES))),
            0x4E: (4, self._set_timer),
            0x4F: (0, lambda _: (Code.OK, struct.pack("<I", self._timer))),
            0x65: (0, lambda _: (Code.OK, bytes(4))),
            0xA0: (8, self._start_stream),
        }

    # ------------------------------------------------------------------ the controller

    def _units(self) -> bytes:
        units = [("LJ-X8000A", self._serial), ("LJ-X8060", f"H{self._serial}")]
        data = struct.pack("<B15x", len(units))
        return data + b"".join(struct.pack("<32s16s4x", model.encode(), number.encode()) for model, number in units)

    @property
    def _saving(self) -> bool:
        return time.monotonic() < self._saved_at + SAVING

    def _saved(self, level: int) -> None:
        if level == settings.SAVED:
            self._saved_at = time.monotonic()

    def _reboot(self, _: bytes) -> Answer:
        if self._saving:
            return Code.SAVE_AREA_BUSY, b""
        self.restarts = True
        return Code.OK, b""

    def _reset(self, _: bytes) -> Answer:
        if self._measuring.streaming:
            return Code.WRONG_STATE, b""
        self._settings.reset()
        self._saved(settings.SAVED)
        self._program, self._timer = 0, 0
        return Code.OK, b""

    def _clear_error(self, arguments: bytes) -> Answer:
        wanted = struct.unpack_from("<H", arguments)[0]
        self.errors = [error for error in self.errors if error != wanted]
        return Code.OK, b""

    def _control_laser(self, arguments: bytes) -> Answer:
        if arguments[0] > 1:
            return Code.WRONG_PARAMETER, b""
        self._measuring.laser = bool(arguments[0])
        return Code.OK, b""

    def _set_x_pitch(self, arguments: bytes) -> Answer:
        if self._measuring.streaming:
            return Code.WRONG_STATE, b""
        pitch = struct.unpack("<I", arguments)[0]
        if not pitch:
            return Code.WRONG_PARAMETER, b""
        self._x_pitch = pitch
        return Code.OK, b""

    def _set_timer(self, arguments: bytes) -> Answer:
        self._timer = struct.unpack("<I", arguments)[0]
        return Code.OK, b""

    def _change_program(self, arguments: bytes) -> Answer:
        if arguments[0] >= wire.PROGRAMS:
            return Code.WRONG_PARAMETER, b""
        if self._measuring.streaming:
            return Code.WRONG_STATE, b""
        self._program = arguments[0]
        return Code.OK, b""

    # ------------------------------------------------------------------ settings

    def _get_setting(self, arguments: bytes) -> Answer:
        kind, category, item = arguments[8:11]
        data = self._settings.read(arguments[4], (kind, category, item, arguments[12:16]))
        return (Code.WRONG_PARAMETER, b"") if data is None else (Code.OK, data)

    def _set_setting(self, arguments: bytes) -> Answer:
        level, (kind, category, item) = arguments[0], arguments[4:7]
        data = arguments[12:]
        if self._measuring.streaming and level:
            return Code.WRONG_STATE, b""
        if not self._settings.write(level, (kind, category, item, arguments[8:12]), data):
            return Code.WRONG_PARAMETER, b""
        self._saved(level)
        return Code.OK, bytes(4)  # no detailed error

    def _initialise(self, arguments: bytes) -> Answer:
        level, kind, program = arguments[0], arguments[4], arguments[5]
        if level > settings.SAVED or kind != 3 or program >= wire.PROGRAMS:
            return Code.WRONG_PARAMETER, b""
        self._settings.initialise(level, program)
        self._saved(level)
        return Code.OK, b""

    def _reflect(self, reflect: bool, arguments: bytes) -> Answer:
        level = arguments[0] if reflect else arguments[0] + 1  # the library sends the level less 1 with 0x35
        if level not in (settings.RUNNING, settings.SAVED):
            return Code.WRONG_PARAMETER, b""
        if not reflect:
            self._settings.rewrite(level)
            return Code.OK, b""
        if self._measuring.streaming:
            return Code.WRONG_STATE, b""
        self._settings.reflect(level)
        self._saved(level)
        return Code.OK, bytes(4)

    def _setting(self, item: tuple[int, int]) -> int:
        return self._settings.value(self._program, item)

    # ------------------------------------------------------------------ measurement

    @property
    def _batches(self) -> bool:
        return bool(self._setting(settings.BATCH))

    def _trigger(self, _: bytes) -> Answer:
        if self._setting(settings.TRIGGER_MODE) != settings.EXTERNAL:
            return Code.REFUSED_BY_SETTING, b""
        if self._measuring.measuring:
            self._measuring.feed.trigger()
        return Code.OK, b""

    def _start_batch(self, _: bytes) -> Answer:
        if not self._batches:
            return Code.REFUSED_BY_SETTING, b""
        if not self._measuring.laser:
            return Code.LASER_OFF, b""
        if self._measuring.measuring:
            return Code.OK, b""  # a running batch continues
        started = self._measuring.start_batch(self.layout, self._setting(settings.BATCH_POINTS))
        return Code.OK if started else Code.WRONG_STATE, b""

    def _stop_batch(self, _: bytes) -> Answer:
        if not self._batches:
            return Code.REFUSED_BY_SETTING, b""
        if not self._measuring.laser:
            return Code.LASER_OFF, b""
        self._measuring.stop_batch()
        return Code.OK, b""

    def _clear_memory(self, _: bytes) -> Answer:
        self._measuring.clear()
        self._cleared_since = True
        return Code.OK, b""

    def _counts(self, _: bytes) -> Answer:
        encoder = (self._measuring.feed.count() + (1 << 31)) % (1 << 32) - (1 << 31)
        return Code.OK, struct.pack("<Ii", self._measuring.trigger_count, encoder)

    def _prepare(self, arguments: bytes) -> Answer:
        if self._measuring.streaming:
            return Code.STREAMS_ALREADY, b""
        position = arguments[0]
        if position > 2:
            return Code.WRONG_PARAMETER, b""
        if position == 1 and not self._measuring.has_unsent_or_kept():
            return Code.NO_SUCH_START, b""
        self._starts += 1
        self._cleared_since = False
        self._prepared = self.layout, position
        return Code.OK, struct.pack("<4xi4x", self.layout.start_code) + self.layout.block()

    def _start_stream(self, arguments: bytes) -> Answer:
        command, start_code = struct.unpack("<Ii", arguments)
        if self._measuring.streaming:
            return Code.STREAMS_ALREADY, b""
        if command != 0x47:
            return Code.OTHER_COMMAND_CODE, b""
        if self._prepared is None or start_code != self._prepared[0].start_code:
            return Code.OTHER_START_CODE, b""
        layout, position = self._prepared
        if position < 2 and self._cleared_since:
            return Code.DATA_CLEARED, b""
        if not self._connected():
            return Code.NO_CONNECTION, b""
        self._prepared = None
        started = self._measuring.start_stream(layout, position, self._batches)
        return Code.OK if started else Code.WRONG_STATE, b""

    def _stop_stream(self, _: bytes) -> Answer:
        self._measuring.stop_stream(self._batches)
        return Code.OK, b""

    def _get_profile(self, arguments: bytes) -> Answer:
        if self._batches:
            return Code.OTHER_BATCH_SETTING, b""
        measuring = self._measuring
        if not measuring.measuring and isinstance(measuring.feed, FreeRunning):
            measuring.grab(self.layout)
        return single_profiles(measuring.memory, self.layout, arguments)

    def _get_batch_profile(self, arguments: bytes) -> Answer:
        if not self._batches:
            return Code.OTHER_BATCH_SETTING, b""
        return batch_profiles(self._measuring.memory, self.layout, arguments)
