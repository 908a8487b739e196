"""Multilateration: volumetric errors from displacements of a reflector, measured from four or more places.

``method`` is the plugin, ``identification`` what it does with raw data (``reading``): ``refraction`` and ``expansion``
are the scale, ``drift`` is what places visited again tell, ``moving`` which station was moved, ``parameters`` are the
errors of the axes, and ``volume`` is what these make of any grid.

The numbers: ``solver`` (Gauss-Newton with every target eliminated), over ``model`` (the equations), ``kernels``
and ``examination`` (compiled loops: to the solution, and at it), ``start`` (where the stations are, roughly),
``turning`` (the datum), ``outliers`` (readings that are wrong), ``determinacy`` (what distances determine), ``network``
(the answer and its covariances); ``bound`` foretells them without readings, and ``alternating`` is the scheme of the
paper. Source: Takeuchi et al., estimation of three-dimensional volumetric
errors of numerically controlled machine tools by a laser tracker.
"""

from errormotion.methods.multilateration.method import Multilateration
from errormotion.methods.multilateration.settings import Settings

__all__ = ["Multilateration", "Settings"]
