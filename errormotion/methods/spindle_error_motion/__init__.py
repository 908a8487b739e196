"""Error motions of a turning spindle (ISO 230-7, ASME B89.3.4): displacement sensors look at a ball or a bar in it.

``method`` is the plugin, ``model`` its measurement model, ``layout`` the geometry of the sensors, ``turning`` the angle
of the spindle at every sample, ``averaging`` the passes over a record of any length, ``synchronous`` its mean over
turns, and ``figures`` the values of the standard.
"""

from errormotion.methods.spindle_error_motion.method import SpindleErrorMotion
from errormotion.methods.spindle_error_motion.settings import SpindleErrorMotionSettings

__all__ = ["SpindleErrorMotion", "SpindleErrorMotionSettings"]
