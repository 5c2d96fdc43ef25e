"""Plane-stress finite elements of the body (extra ``fem``): outline, mesh, solution, strain of gauges."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce_lab.fem.mesh import Resolution as Resolution
    from tipforce_lab.fem.plane_stress import Model as Model
    from tipforce_lab.fem.plane_stress import corner_exponent as corner_exponent
    from tipforce_lab.fem.plane_stress import solve as solve
    from tipforce_lab.fem.plane_stress import strain_matrix as strain_matrix
else:
    __getattr__, __dir__, __all__ = lazy(globals())
