"""Random controls, with odd tool tables, and random programs that read their state."""

from pathlib import Path
from random import Random

from errormotion.compensation.program.reading.offsets import Offsets, read_parameters
from errormotion.compensation.program.reading.tools import read_table

TOOLS = (1, 2, 3)


def control(random: Random, folder: Path) -> Offsets:
    """Return the control of a random parameter file and a random tool table, written to a folder."""
    unit = random.choice(("mm", "inch"))
    one = 1.0 if unit == "mm" else 1 / 25.4
    values = {k: round(random.uniform(-20, 20) * one, 4) for k in range(100, 111)}
    values |= {first + k: round(random.uniform(-50, 50) * one, 4) for first in (5161, 5181) for k in range(3)}
    values |= {5210: random.choice((0, 0, 1)), 5220: random.choice((1, 1, 2))}
    values |= {5211 + k: round(random.uniform(-30, 30) * one, 4) for k in range(3)}
    for system in range(9):
        values |= {5221 + 20 * system + k: 0 for k in range(10)}
        values |= {5221 + 20 * system + k: round(random.uniform(-40, 40) * one, 4) for k in range(3)}
    (folder / "a.var").write_text("".join(f"{key}\t{value}\n" for key, value in sorted(values.items())))
    lines = []
    for tool in random.sample([*TOOLS, *random.sample(TOOLS, 2)], 5):
        words = [f"T{tool}", f"P{random.randint(1, 9)}"]
        words += [f"{axis}{random.uniform(-30, 30) * one:.3f}" for axis in random.sample("XYZ", random.randint(1, 3))]
        words += [f"D{random.uniform(0.5, 6) * one:.4f}"] * random.choice((0, 1, 1, 1))
        words += [f"I{random.randint(0, 90)}", f"J{random.randint(0, 90)}"]
        words += [f"Q{random.randint(0, 9)}"] * (random.random() < 0.03)
        text = random.choice(("", "", " ")) + random.choice((" ", " ", "  ")).join(words)
        if random.random() < 0.15:
            k = text.index("P") + 2  # without P, LinuxCNC loses the tool when another one is changed
            text = text[:k] + text[k:].replace(" ", random.choice(("\t", "")), 1)
        lines.append(text + random.choice(("", "", " ; tool", ";T9 P1 Z3")))
        lines += random.choice(([], [], [""], ["; comment"]))
    (folder / "a.tbl").write_text("\n".join(lines) + "\n")
    return read_parameters(folder / "a.var", unit).with_tools(read_table(folder / "a.tbl", unit))


class Reading:
    """Makes programs that the plain reader does not read: they depend on the state of their control."""

    def __init__(self, random: Random, unit: str) -> None:
        self.random, self.unit = random, unit
        self.one = 1.0 if unit == "mm" else 1 / 25.4

    def lines(self, blocks: int) -> list[str]:
        """Return one program, in the unit of the machine."""
        self.label, self.known, self.g92 = 100, [f"#{k}" for k in range(100, 111)], self.random.random() < 0.3
        code = "G21" if self.unit == "mm" else "G20"
        head = self.random.choice((["%"], ["O0001"], ["%", "O0002 (part)"], []))
        lines = [f"{code} G90 G17 G94 G40 G49 G91.1 G98 S900 M3", *self._tool(), *self._away(), f"F{self._value(300)}"]
        steps = [self._cut, self._cut, self._set, self._compensated, self._cycle, self._loop, self._branch, self._sub]
        steps += [self._offset, self._tool_and_away, self._arc, self._home]
        for _ in range(blocks):
            lines += self.random.choice(steps)()
        return [*head, *lines, "M2", *(["%"] if "%" in head else [])]

    def _number(self, reach: float) -> float:
        return round(self.random.uniform(-reach, reach) * self.one, 3)

    def _value(self, value: float) -> str:
        return f"{value * self.one:.4f}"

    def _read(self) -> str:
        """Return an expression of a parameter with a small value."""
        k = self.random.randint(0, 2)
        of_control = [f"#{5221 + k}", f"# 52 {41 + k}", f"#{5401 + k}", "#5410", "#<_task>", f"#{5161 + k}"]
        of_control += ["#5400", "#<_current_tool>", "#<_metric>", "#[100+5]", "##1", "#5220", "#5413", "#<_absolute>"]
        of_control += [] if self.g92 else [f"#{5211 + k}"]
        return self.random.choice([*self.known, *of_control])

    def _position(self) -> str:
        words = []
        for axis in self.random.sample("XYZ", self.random.randint(1, 3)):
            text = f"[{self._read()} + {self._number(60)}]" if self.random.random() < 0.5 else str(self._number(80))
            words.append(axis + text)
        return " ".join(words)

    def _cut(self) -> list[str]:
        lines = [f"#1={self.random.randint(100, 110)}", f"{self.random.choice(('G1', 'G0', 'G1'))} {self._position()}"]
        return lines + self.random.choice(([], ["G1"], ["G0", "(note #5)"]))

    def _set(self) -> list[str]:
        k = self.random.randint(31, 40)
        line = f"#{k} = [{self._read()} / 2]"
        self.known.append(f"#{k}")
        return ["#1=105", line]

    def _away(self) -> list[str]:
        return [f"G0 X{self._number(50)} Y{self._number(50)} Z{self._number(50)}"]

    def _tool(self) -> list[str]:
        tool = self.random.choice(TOOLS)
        return [
            f"T{tool} M6",
            self.random.choice(("G43", f"G43 H{tool}", f"G43 H{self.random.choice(TOOLS)}", "G43 H#5400")),
        ]

    def _tool_and_away(self) -> list[str]:
        return [*self._tool(), *self._away()]

    def _compensated(self) -> list[str]:
        x, y, z = self._number(20), self._number(20), self._number(20)
        side = self.random.choice(("G41", "G42"))
        radius = self.random.choice(("", f" D{self.random.choice(TOOLS)}", " D#5400", f".1 D{self._value(4)}"))
        size = [round(self.random.uniform(30, 60) * self.one, 3) for _ in range(4)]
        legs = [
            f"G1 X{x + size[0]:.4f} Y{y:.4f}",
            f"X{x + size[0]:.4f} Y{y + size[1]:.4f}",
            f"X{x:.4f} Y{y + size[1]:.4f}",
        ]
        if self.random.random() < 0.5:
            legs[1] = f"G3 X{x + size[0]:.4f} Y{y + 2 * size[1]:.4f} J{size[1]:.4f}"
            legs[2] = f"G1 X{x:.4f} Y{y + 2 * size[1]:.4f}"
        far = f"X{x - size[2]:.4f} Y{y - size[3]:.4f}"
        return [f"G0 {far} Z{z:.4f}", f"{side}{radius} G1 X{x:.4f} Y{y:.4f}", *legs, f"G40 G1 {far}"]

    def _cycle(self) -> list[str]:
        code = self.random.choice(("G81", "G82", "G83", "G73", "G85", "G89"))
        more = {"G83": f" Q{self._value(2)}", "G73": f" Q{self._value(2)}", "G82": " P0.1", "G89": " P0.1"}.get(
            code, ""
        )
        z = self._value(60)
        depth = self._value(-self.random.uniform(1, 8))
        line = f"{code} X{self._number(50)} Y{self._number(50)} Z{depth} R{self._value(2)}{more}"
        return [f"G0 Z{z}", self.random.choice(("G98", "G99")), line, f"X{self._number(50)}", "G80", f"G0 Z{z}"]

    def _next(self) -> str:
        self.label += 1
        return f"o{self.label}"

    def _loop(self) -> list[str]:
        o = self._next()
        body = [f"G1 X[#2 * {self._number(20)}] Y{self._read().replace('##1', '#103')}", "#2=[#2+1]"]
        kind = self.random.choice(("while", "do", "repeat"))
        if kind == "while":
            return ["#2=0", f"{o} while [#2 LT 3]", *body, f"{o} endwhile"]
        if kind == "do":
            return ["#2=0", f"{o} do", *body, f"{o} while [#2 LT 3]"]
        return ["#2=0", f"{o} repeat [3]", *body, f"{o} endrepeat"]

    def _branch(self) -> list[str]:
        o = self._next()
        test = self.random.choice(
            ("#<_task> EQ 1", "#101 GT 0", "#5410 GT 2", "#5223 LT 0", "#<_metric> EQ 1", "#5400 EQ 2")
        )
        return [f"{o} if [{test}]", f"G1 {self._plain()}", f"{o} else", f"G1 {self._plain()}", f"{o} endif"]

    def _plain(self) -> str:
        return f"X{self._number(80)} Y{self._number(80)}"

    def _sub(self) -> list[str]:
        o = self._next()
        body = [f"#35 = {self._read().replace('##1', '#104')}", "G1 X[#1 + #3] Y#2 Z[#35 / 4]"]
        self.known.append("#35")
        return [f"{o} sub", *body, f"{o} endsub", f"{o} call [{self._number(40)}] [#10{self.random.randint(0, 9)}]"]

    def _offset(self) -> list[str]:
        kinds = [
            "G54",
            "G55",
            "G59.3",
            "G92.3",
            "G92.2",
            "G92.1",
            f"G10 L2 P1 X{self._number(20)}",
            *(["G92"] if self.g92 else []),
        ]
        line = self.random.choice(kinds)
        if line == "G92":
            line = f"G92 X{self._number(20)}"
            return [*self._away(), line, *self._away()]
        return [line, *self._away()]

    def _arc(self) -> list[str]:
        x, y, r = self._number(20), self._number(20), round(self.random.uniform(3, 20) * self.one, 3)
        end = self.random.choice(
            (f"X{x + r:.4f} Y{y + r:.4f}", f"X{x:.4f} Y{y:.4f}", f"X{x + r:.4f} Y{y - r:.4f} Z[#105]")
        )
        return [f"G1 X{x:.4f} Y{y:.4f}", f"{self.random.choice(('G2', 'G3'))} {end} I{r:.4f} J0"]

    def _home(self) -> list[str]:
        axis = self.random.choice("XYZ")
        line = self.random.choice((f"G91 G28 {axis}0", f"G91 G30 {axis}{self._value(3)}"))
        return [line, "G90", *self._away()]
