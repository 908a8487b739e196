"""LinuxCNC's modules without LinuxCNC; processes that stand for it import nothing else."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

AXIS = {"min_position_limit": -100.0, "max_position_limit": 100.0}


class FakeLinuxCNC:
    """LinuxCNC's module with its machine: every line of MDI is executed at once."""

    STATE_ESTOP, STATE_ESTOP_RESET, STATE_OFF, STATE_ON = 1, 2, 3, 4
    MODE_MANUAL, MODE_AUTO, MODE_MDI = 1, 2, 3
    INTERP_IDLE, INTERP_READING = 1, 2
    RCS_DONE, RCS_EXEC, RCS_ERROR = 1, 2, 3
    NML_ERROR, OPERATOR_ERROR, OPERATOR_TEXT = 1, 11, 12
    AUTO_RUN, SPINDLE_OFF = 0, 0
    version = "2.9.fake"

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.texts: list[tuple[int, str]] = []
        self.on_mdi: Callable[[str], None] = lambda line: None
        self.on_run: Callable[[], None] = lambda: None
        self.values = SimpleNamespace(
            **dict.fromkeys(("actual_position", "position", "g5x_offset", "g92_offset", "tool_offset"), (0.0,) * 9),
            axis=(AXIS,) * 3,
            linear_units=1.0,
            current_vel=0.0,
            ini_filename="/there/machine.ini",
            file="",
            gcodes=(210, 900, 940),
            homed=(1, 1, 1),
            joint=({"homing": 0},) * 3,
            joints=3,
            interp_state=self.INTERP_IDLE,
            state=self.RCS_DONE,
            task_state=self.STATE_ON,
            task_mode=self.MODE_MANUAL,
            echo_serial_number=0,
            queue=0,
            inpos=True,
            probe_val=0,
            probe_tripped=False,
            probed_position=(0.0,) * 9,
            rotation_xy=0.0,
            spindle=({"speed": 0.0, "direction": 0},),
        )
        self.values.poll = lambda: None
        self.deaf = False

    def stat(self) -> Any:
        return self.values

    def command(self) -> Any:
        return self

    def error_channel(self) -> Any:
        return SimpleNamespace(poll=lambda: self.texts.pop(0) if self.texts else None)

    def ini(self, file: str) -> Any:
        return SimpleNamespace(find=lambda section, name: None)

    @property
    def serial(self) -> int:
        return len(self.lines)

    def _took(self, text: str) -> None:
        self.lines.append(text)
        self.values.echo_serial_number = 0 if self.deaf else len(self.lines)

    def mode(self, mode: int) -> None:
        self._took(f"mode {mode}")
        self.values.task_mode = mode

    def state(self, state: int) -> None:
        self._took(f"state {state}")
        self.values.task_state = state

    def mdi(self, line: str) -> None:
        self._took(line)
        self.on_mdi(line)

    def abort(self) -> None:
        self._took("abort")
        self.values.interp_state = self.INTERP_IDLE

    def auto(self, what: int, line: int) -> None:
        self._took("run")
        self.on_run()

    def program_open(self, file: str) -> None:
        self._took("open")
        self.values.file = file

    def home(self, joint: int) -> None:
        self._took("home")

    def teleop_enable(self, on: int) -> None:
        self._took(f"teleop {on}")

    def spindle(self, what: int) -> None:
        self._took(f"spindle {what}")

    def error(self, text: str) -> None:
        self.texts.append((self.OPERATOR_ERROR, text))


class FakeHAL:
    def __init__(self) -> None:
        self.pins: dict[str, float] = {}

    def get_value(self, name: str) -> float:
        return self.pins[name]

    def pin_has_writer(self, name: str) -> bool:
        return name in self.pins

    def set_p(self, name: str, value: str) -> None:
        self.pins[name] = float(value)
