"""Random NC programs that move within a cube of some 200 mm, in all the ways that the plain reader knows."""

import math
from random import Random

AXES = "XYZ"
PLANES = {17: (0, 1, 2), 18: (2, 0, 1), 19: (1, 2, 0)}


class Programs:
    """Makes programs that are valid for LinuxCNC's interpreter.

    ``plain`` leaves out what changes offsets, probes, or moves in machine coordinates.
    """

    def __init__(self, random: Random, *, plain: bool = False, inches: bool = True) -> None:
        self.random, self.plain, self.inches = random, plain, inches

    def lines(self, blocks: int) -> list[str]:
        """Return one program."""
        self.at = [0.0, 0.0, 0.0]
        self.unit, self.absolute, self.centre_absolute, self.plane, self.feed_mode = 21, True, False, 17, 94
        self.motion = None
        self.number = 0
        self.turned = self.shifted = False
        out = ["G21 G90 G91.1 G17 G94 G54 G49 G92.1 G40", *self._reposition(), "F300 S1000"]
        for _ in range(blocks):
            out += self._block()
        return [*out, "M2"]

    def _block(self) -> list[str]:
        choices = [self._line] * 6 + [self._arc] * 5 + [self._mode] * 3 + [self._other] * 2
        if not self.plain:
            choices += [self._offset] * 2 + [self._special]
        return self.random.choice(choices)()

    def _value(self, value: float) -> str:
        decimals = self.random.choice((0, 1, 3, 3, 4, 5)) if self.unit == 21 else self.random.choice((2, 3, 4, 5, 6))
        text = f"{value:.{decimals}f}"
        if self.random.random() < 0.1 and text.startswith("0."):
            text = text[1:]
        return ("+" if self.random.random() < 0.05 and not text.startswith("-") else "") + text

    def _target(self) -> list[float]:
        reach = 100.0 if self.unit == 21 else 4.0
        near = self.random.random() < 0.4
        return [
            a + self.random.uniform(-reach / 100, reach / 100) if near else self.random.uniform(-reach, reach)
            for a in self.at
        ]

    def _axis_words(self, target: list[float], axes: list[int]) -> tuple[list[str], list[float]]:
        words, end = [], list(self.at)
        for k in axes:
            text = self._value(target[k] if self.absolute else target[k] - self.at[k])
            end[k] = float(text) if self.absolute else self.at[k] + float(text)
            words.append(self._spaced(AXES[k], text))
        return words, end

    def _spaced(self, letter: str, text: str) -> str:
        letter = letter.lower() if self.random.random() < 0.1 else letter
        return letter + (" " if self.random.random() < 0.05 else "") + text

    def _finish(self, words: list[str], motion: int | None = None) -> str:
        before = []
        if self.random.random() < 0.5:
            self.number += 10
            before.append(f"N{self.number}")
        if motion is not None and (motion != self.motion or self.random.random() < 0.3):
            words = [self.random.choice((f"G{motion}", f"G0{motion}")), *words]
            self.motion = motion
        if motion not in (None, 0) and self.feed_mode == 93:
            words.append(f"F{self.random.uniform(0.5, 20):.3f}")
        elif motion not in (None, 0) and self.random.random() < 0.1:
            words.append(f"F{self.random.uniform(50, 900):.1f}")
        if self.random.random() < 0.08:
            words.insert(self.random.randrange(len(words) + 1), self.random.choice(("(note X5)", "M8", "S1200", "M3")))
        if self.random.random() < 0.03:
            words.append("; to the end (G1 X1)")
        return self.random.choice((" ", " ", "", "\t")).join([*before, *words])

    def _line(self) -> list[str]:
        motion = self.random.choice((0, 1, 1, 1))
        axes = sorted(self.random.sample(range(3), self.random.choice((1, 2, 2, 3))))
        self.random.random() < 0.2 and axes.reverse()
        words, self.at = self._axis_words(self._target(), axes)
        return [self._finish(words, motion)]

    def _arc(self) -> list[str]:
        a, b, c = PLANES[self.plane]
        motion = self.random.choice((2, 3))
        size = 40.0 if self.unit == 21 else 1.6
        radius = 10 ** self.random.uniform(-1.5, 0) * size
        angle = self.random.uniform(0, 2 * math.pi)
        centre = [self.at[a] + radius * math.cos(angle), self.at[b] + radius * math.sin(angle)]
        offsets = [f"{centre[0] - self.at[a]:.6f}", f"{centre[1] - self.at[b]:.6f}"]
        centre = [self.at[a] + float(offsets[0]), self.at[b] + float(offsets[1])]
        turn = self.random.choice((1, 1, 1, 2)) * 2 * math.pi * self.random.choice((1.0, *[self.random.random()] * 4))
        if turn % (2 * math.pi) > 6.2 or turn < 0.02:
            turn = 2 * math.pi
        back = angle + math.pi + (turn if motion == 3 else -turn)
        radius = math.hypot(self.at[a] - centre[0], self.at[b] - centre[1])
        first = math.atan2(self.at[b] - centre[1], self.at[a] - centre[0])
        back = first + (turn if motion == 3 else -turn)
        end = list(self.at)
        if turn != 2 * math.pi:
            end[a], end[b] = centre[0] + radius * math.cos(back), centre[1] + radius * math.sin(back)
        words = []
        for k in (a, b):
            shown = f"{end[k] if self.absolute else end[k] - self.at[k]:.6f}"
            if turn == 2 * math.pi:
                continue
            words.append(self._spaced(AXES[k], shown))
            end[k] = float(shown) if self.absolute else self.at[k] + float(shown)
        if self.random.random() < 0.4:
            text = self._value(self._target()[c] if self.absolute else self._target()[c] - self.at[c])
            end[c] = float(text) if self.absolute else self.at[c] + float(text)
            words.append(AXES[c] + text)
        if self.random.random() < 0.3 and 0.1 < turn < 5.0:
            words.append(f"R{'-' if turn > math.pi else ''}{radius * (1 + 1e-9):.7f}")
        elif self.centre_absolute:
            words += [f"{'IJK'[a]}{centre[0]:.6f}", f"{'IJK'[b]}{centre[1]:.6f}"]
        else:
            words += [f"{'IJK'[k]}{text}" for k, text in ((a, offsets[0]), (b, offsets[1])) if float(text)]
        turns = math.ceil(turn / (2 * math.pi) - 1e-9)
        if turns > 1 or (turn == 2 * math.pi and self.random.random() < 0.2):
            turns = max(turns, self.random.choice((1, 2, 3)))
            words.append(f"P{turns}")
        self.at = end
        return [self._finish(words, motion)]

    def _mode(self) -> list[str]:
        kind = self.random.choice((*(("unit",) if self.inches else ()), "distance", "centre", "plane", "feed"))
        if kind == "unit":
            self.unit = 41 - self.unit
            ratio = 25.4 if self.unit == 21 else 1 / 25.4
            self.at = [value * ratio for value in self.at]
            return [f"G{self.unit}"]
        if kind == "distance":
            self.absolute = not self.absolute
            return [f"G{90 if self.absolute else 91}"]
        if kind == "centre":
            self.centre_absolute = not self.centre_absolute
            return [f"G{90.1 if self.centre_absolute else 91.1}"]
        if kind == "plane":
            self.plane = self.random.choice((17, 18, 19))
            return [f"G{self.plane}"]
        self.feed_mode = self.random.choice((93, 94, 95))
        return [f"G{self.feed_mode}", *([] if self.feed_mode == 93 else [f"F{0.2 if self.feed_mode == 95 else 300}"])]

    def _other(self) -> list[str]:
        if self.random.random() < 0.1 and self.feed_mode != 93:
            self.motion = self.random.choice((0, 1))
            return [f"G{self.motion}"]
        others = ("(comment)", "M9", "M5", "M3 S900", "G4 P0.5", "", "; text", "M64 P1", "G61", "G64 P0.01")
        return [self.random.choice(others)]

    def _reposition(self) -> list[str]:
        """Return a move to a stated position with all axes, in absolute coordinates."""
        self.absolute, self.motion = True, None
        words, self.at = self._axis_words(self._target(), [0, 1, 2])
        return ["G90", self._finish(words, 0)]

    def _offset(self) -> list[str]:
        kind = self.random.choice(("system", "define", "rotate", "g92", "off", "store", "tool", "length", "l20"))
        v = [f"{self.random.uniform(-20, 20) * (1 if self.unit == 21 else 0.04):.3f}" for _ in range(3)]
        if kind == "system":
            line = "G" + self.random.choice(("54", "55", "56", "57", "58", "59", "59.1", "59.2", "59.3"))
        elif kind == "define":
            line = f"G10 L2 P{self.random.randrange(10)} X{v[0]} Z{v[2]}"
        elif kind == "rotate":
            self.turned = True
            line = f"G10 L2 P{self.random.randrange(10)} R{self.random.choice((0, 30, -45.5))}"
        elif kind == "g92":
            line = f"G92 X{v[0]} Y{v[1]}"
        elif kind == "off":
            line = self.random.choice(("G92.1", "G92.2", "G92.3"))
        elif kind == "tool":
            line = f"T{self.random.randint(1, 3)} M6"
            return [line, "G43", *self._reposition()]
        elif kind == "length":
            line = self.random.choice(("G49", "G43 H2", f"G43.1 Z{v[2]}", "G43 H0"))
        elif kind == "l20" and not self.turned:
            line = f"G10 L20 P{self.random.randrange(10)} X{v[0]} Y{v[1]}"
        else:
            line = f"G10 L2 P1 Y{v[1]}"
        return [line, *self._reposition()]

    def _special(self) -> list[str]:
        if self.turned:
            return self._reposition()
        if self.random.random() < 0.5:
            return ["G90", f"G53 G0 {self.random.choice(AXES)}{self._value(1.5)}", *self._reposition()]
        probe = f"G38.{self.random.choice('2345')} Z{self.at[2] - 1.3:.3f}"
        feed = [] if self.feed_mode == 93 else ["F200"]
        return ["G90 G94 F100", probe, f"G{self.feed_mode}", *feed, *self._reposition()]
