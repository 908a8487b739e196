"""Registration of two height maps: how the profiler's frame has moved between a cold and a warm scan.

``prepare`` reduces a scan to blocks, once; ``register`` finds the pose of the warm scan's frame in the cold one's,
with its covariance. Beneath them: ``blocks`` (a scan as blocks: ``reduction``, repair), ``surface`` (the cold scan as a
spline), ``solver`` (Gauss-Newton with line effects), ``comparison`` (its residuals), ``freedoms`` (what an artefact
determines), ``kernels`` (compiled loops for large campaigns), ``clouds`` (Open3D and the
published chain, for comparison). ``register_clouds`` takes two clouds that are no height map (``general``).

The pose M takes a point from the warm frame to the cold one: a surface point at p in the warm scan is at M p in the
cold one. It is the pose of the warm frame in the cold frame, so its twist is how the profiler moved, relative to the
artefact.
"""

from errormotion.methods.crossbeam_scan.identification.registration.blocks import BlockMap, prepare
from errormotion.methods.crossbeam_scan.identification.registration.general import register_clouds
from errormotion.methods.crossbeam_scan.identification.registration.register import Registration, register

__all__ = ["BlockMap", "Registration", "prepare", "register", "register_clouds"]
