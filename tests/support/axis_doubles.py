"""A machine with one axis, and instruments that read it, for tests of measuring."""

from types import SimpleNamespace

import numpy as np

from errormotion.plugins.readings import Measurement

PITCH = 20e-6  # rad/m
BACKLASH = 3e-6


def error(x):
    """Return the true positioning error at a position, m."""
    return 8e-6 * x + 2e-6 * np.sin(9.0 * x)


class Machine:
    """An axis with an error and a reversal error, and a clock of its own."""

    def __init__(self):
        self.place, self.actual, self.time, self.path = np.zeros(3), 0.0, 0.0, []

    def move_to(self, position, feed=None):
        x = position[0]
        lost = BACKLASH / 2.0 * np.sign(x - self.place[0])
        self.actual = x + error(x) + lost
        self.place = np.array(position, float)
        self.path.append(x)
        self.time += 1.0

    def elapse(self, seconds):
        self.time += seconds

    def state(self):
        return {"position": list(self.place), "time": self.time, "running": False}


class Interferometer:
    """Counts the displacement down, and the pitch; ``broken`` lists readings that break the beam."""

    info = SimpleNamespace(id="interferometer")
    channels = {"length": "m", "pitch": "rad"}  # noqa: RUF012

    def __init__(self, machine, broken=()):
        self.machine, self.broken, self.count, self.start, self.zeros = machine, set(broken), 0, None, 0

    def zero(self):
        self.start, self.zeros = self.machine.actual, self.zeros + 1

    def read(self):
        if self.count in self.broken:
            self.start = None
        self.count += 1
        if self.start is None:
            return {"length": np.nan, "pitch": np.nan}
        way = self.machine.actual - self.start
        return {"length": -way, "pitch": PITCH * way}


class Tracker:
    """A tracker on the far side of the axis, 5 mm off its line; ``renewed`` lists measurements with a new dead path."""

    info = SimpleNamespace(id="tracker")

    def __init__(self, machine, renewed=()):
        self.machine, self.renewed, self.count, self.path = machine, set(renewed), 0, 0

    def measure(self, target=None):
        self.path += self.count in self.renewed
        self.count += 1
        seen = np.array([2.0 - self.machine.actual, 0.005, 0.0])
        r = np.linalg.norm(seen)
        return Measurement(float(r), (float(np.arctan2(seen[1], seen[0])), np.pi / 2), valid=True, dead_path=self.path)


class Thermometer:
    channels = ("ball screw", "air")

    def read(self):
        return {"ball screw": 22.0, "air": 24.0}


class Bench:
    machine = "test"
    description = None

    def __init__(self, **kinds):
        self.kinds = kinds

    def of_kind(self, kind):
        return self.kinds[kind]

    def has_kind(self, kind):
        return kind in self.kinds
