"""Time on real and virtual machines: the clock of a virtual machine advances only by what is done with it.

The driver of the controller of a virtual machine states ``virtual`` (bool), has ``elapse(seconds)``, which advances the
clock, and may have ``act(action, **values)``, which does what an operator is requested to do (see `Bench.ask`). None of
them is part of the contract of a controller.
"""

from __future__ import annotations

import time
from typing import Any


def is_virtual(controller: Any) -> bool:
    """Return whether a controller is that of a virtual machine."""
    return bool(getattr(controller, "virtual", False))


def wait(controller: Any, seconds: float) -> None:
    """Let time pass, s: on the clock of a virtual machine, else in real time.

    Parameters
    ----------
    controller : controller or None
        A real one may also have ``elapse``, which waits and which ``stop`` ends.
    """
    if hasattr(controller, "elapse"):
        controller.elapse(seconds)
    else:
        time.sleep(seconds)
