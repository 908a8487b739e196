"""Parts of all touch probes: the probe, the last contact, and the pre-travel map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from errormotion.datasets.calibrations.pretravel import PretravelMap
from errormotion.errors import InstrumentError
from errormotion.plugins import Contact, Touch


class Probe:
    """Base of drivers of touch probes.

    Attributes
    ----------
    last : Contact or None
        The last contact.
    """

    settings: Any
    last: Contact | None = None
    _contacts = 0
    _map: PretravelMap | None = None

    @property
    def tip_radius(self) -> float:
        """Radius of the tip, m."""
        return float(self.settings.tip_radius)

    @property
    def noise(self) -> float:
        """Standard deviation of one touch, m; NaN if unknown."""
        return float(self.settings.touch_noise)

    @property
    def pretravel(self) -> PretravelMap | None:
        """The map that corrects contacts; None without one."""
        return self._map

    def configure(self, settings: Any) -> None:
        """Use other settings from now on; those of the connection take effect at the next opening."""
        self._map = settings.pretravel_map()
        self.settings = settings

    def _keep(self, contact: Contact) -> Contact:
        self.last = contact
        self._contacts += not contact.flag
        return contact


def _normals(touches: Sequence[Touch]) -> list[tuple[float, ...]]:
    """Return the normals of surfaces that are touched along them."""
    return [tuple(float(x) for x in np.subtract(touch.start, touch.target)) for touch in touches]


def refuse_unmapped(pretravel: PretravelMap | None, touches: Sequence[Touch]) -> None:
    """Refuse touches from directions that the pre-travel map does not cover.

    Raises
    ------
    InstrumentError
        The message names the first of them.
    """
    if pretravel is None or not touches:
        return
    unknown = np.flatnonzero(~pretravel.supported(_normals(touches)))
    if unknown.size:
        first = touches[int(unknown[0])]
        raise InstrumentError(
            f"The pre-travel map has no touches near the direction of touch {int(unknown[0]) + 1} (item {first.item}); "
            f"it does not cover {unknown.size} of {len(touches)} touches. Calibrate the probe in these directions, "
            "or use no map",
            code="touch.pre_travel.not_covered",
        )


def corrected(pretravel: PretravelMap | None, touch: Touch, contact: Contact) -> Contact:
    """Return a contact at the position where the tip met the surface; unchanged without a map or with a flag."""
    if pretravel is None or contact.flag:
        return contact
    x, y, z = (float(value) for value in pretravel.met([contact.position], _normals([touch]))[0])
    return replace(contact, position=(x, y, z))
