"""The radial deviation of a circular path from the errors of its two axes.

The commanded position of the tool is ``R u``, with ``u = (cos a, sin a)`` in the plane of the two axes and the angle
``a`` from the first axis towards the second. The sense is s = +1 counterclockwise and s = -1 clockwise, the feed is V,
and the bar measures ``u . e`` of the error e = (e_1, e_2) of tool relative to workpiece. To first order:

===================  ===========================================  ==========================================
parameter            error of the axes                            radial deviation
===================  ===========================================  ==========================================
``squareness`` q     e_1 = -q R sin a                             -(q R / 2) sin 2a
``scale_mismatch``   e_1 = m_1 R cos a, e_2 = m_2 R sin a         ((m_1 - m_2) R / 2) cos 2a, and a constant
``servo_mismatch``   e_i = -t_i v_i (lag of t_i)                  s (V / 2) (t_1 - t_2) sin 2a
``backlash_1`` b_1   e_1 = -(b_1 / 2) sign v_1                    s (b_1 / 2) cos a sign(sin a)
``backlash_2`` b_2   e_2 = -(b_2 / 2) sign v_2                    -s (b_2 / 2) sin a sign(cos a)
``bow_1`` w_1        e_2 = w_1 cos^2 a                            (w_1 / 4) sin 3a, and sin a
``bow_2`` w_2        e_1 = w_2 sin^2 a                            -(w_2 / 4) cos 3a, and cos a
``spike_1`` p_1      e_1 = p_1 sign(cos a) exp(-f / d)            p_1 abs(cos a) exp(-f / d)
``spike_2`` p_2      e_2 = p_2 sign(sin a) exp(-f / d)            p_2 abs(sin a) exp(-f / d)
===================  ===========================================  ==========================================

f is the angle travelled since the last reversal of the axis, and d the decay of its spike. ``squareness`` is the
rotation of the second axis from the right angle to the first, about the normal of the plane: C0Y in plane XY. A bow is
the straightness error of an axis at the ends of the diameter relative to its middle. The second order is the square of
the error across the bar divided by twice the radius: 1 nm for 17 um at a radius of 150 mm.
"""

import numpy as np

TAU = 2 * np.pi
SENSES = {"CCW": 1.0, "CW": -1.0}
DIRECTIONS = tuple(SENSES)
PARAMETERS = (
    "squareness",
    "scale_mismatch",
    "servo_mismatch",
    "backlash_1",
    "backlash_2",
    "bow_1",
    "bow_2",
    "spike_1",
    "spike_2",
)
UNITS = ("rad", "1", "s", *("m",) * 6)
SUBDIVISION = 32  # angles at which a sector is averaged


def since_reversal(angle, sense):
    """Return the angle travelled since the last reversal of the first and of the second axis, rad; in [0, pi)."""
    return np.mod(sense * angle, np.pi), np.mod(sense * (angle - np.pi / 2), np.pi)


def basis(angle, sense, radius, feed, decay):
    """Return the radial deviation by one unit of each parameter, (..., 9); ``sense`` is +1 or -1 at each angle."""
    sin, cos = np.sin(angle), np.cos(angle)
    first, second = since_reversal(angle, sense)
    return np.stack(
        [
            -radius / 2 * np.sin(2 * angle),
            radius / 2 * np.cos(2 * angle),
            sense * feed / 2 * np.sin(2 * angle),
            sense / 2 * cos * np.sign(sin),
            -sense / 2 * sin * np.sign(cos),
            np.sin(3 * angle) / 4,
            -np.cos(3 * angle) / 4,
            np.abs(cos) * np.exp(-first / decay),
            np.abs(sin) * np.exp(-second / decay),
        ],
        axis=-1,
    )


def circle(angle):
    """Return the radial deviation by a unit of radius and of the offset of the path along both axes, (..., 3)."""
    return np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)


def middles(places):
    """Return the angles in the middle of each sector, rad; reversals lie between sectors."""
    return (np.arange(places) + 0.5) * TAU / places


def sector_angles(places):
    """Return evenly spread angles in each sector, (place, k), rad."""
    offsets = (np.arange(SUBDIVISION) + 0.5) / SUBDIVISION - 0.5
    return middles(places)[:, None] + offsets * TAU / places
