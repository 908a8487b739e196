"""Multilateration: volumetric errors from displacements of a reflector, measured from four or more places.

The numbers: ``solver`` (Gauss-Newton with every target eliminated), over ``model`` (the equations), ``kernels``
(compiled loops), ``start`` (where the stations are, roughly), ``outliers`` (readings that are wrong), ``determinacy``
(what distances determine), ``network`` (the answer and its covariances); ``bound`` foretells them without readings,
and ``alternating`` is the scheme of the paper. Source: Takeuchi et al., estimation of three-dimensional volumetric
errors of numerically controlled machine tools by a laser tracker.
"""
