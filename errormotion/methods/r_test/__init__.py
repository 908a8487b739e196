"""R-test of a rotary table: a nest of sensors looks at spheres on the table, which turns.

``method`` is the plugin with its measurement model, ``layout`` the geometry of a test.
"""

from errormotion.methods.r_test.method import RTest
from errormotion.methods.r_test.settings import RTestSettings

__all__ = ["RTest", "RTestSettings"]
