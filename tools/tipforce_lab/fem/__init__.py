"""Plane-stress finite elements of the body (extra ``fem``): outline, mesh, solution, strain of gauges."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce_lab.fem.gauges import corner_exponent as corner_exponent
    from tipforce_lab.fem.gauges import strain_matrix as strain_matrix
    from tipforce_lab.fem.mesh import Resolution as Resolution
    from tipforce_lab.fem.plane_stress import Model as Model
    from tipforce_lab.fem.plane_stress import solve as solve

_MODULES = {
    "Model": "plane_stress",
    "Resolution": "mesh",
    "corner_exponent": "gauges",
    "solve": "plane_stress",
    "strain_matrix": "gauges",
}
__all__ = [
    "Model",
    "Resolution",
    "corner_exponent",
    "solve",
    "strain_matrix",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
