"""Physics of the sensor, without CAN: geometry, strain, force, contact, calibration, dynamics."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.sensor.calibration.data import Model as Model
    from tipforce.sensor.calibration.data import Prior as Prior
    from tipforce.sensor.calibration.data import Readings as Readings
    from tipforce.sensor.calibration.data import beam_prior as beam_prior
    from tipforce.sensor.calibration.fit import fit_calibration as fit_calibration
    from tipforce.sensor.calibration.fit import linear_fit as linear_fit
    from tipforce.sensor.calibration.result import Fit as Fit
    from tipforce.sensor.calibration.result import covariance_of_estimate as covariance_of_estimate
    from tipforce.sensor.calibration.simulation import simulate as simulate
    from tipforce.sensor.contact.estimate import contacts as contacts
    from tipforce.sensor.contact.estimate import standard_uncertainties as standard_uncertainties
    from tipforce.sensor.contact.first_order import curvature as curvature
    from tipforce.sensor.contact.first_order import first_order_holds as first_order_holds
    from tipforce.sensor.contact.force import force_from_strain as force_from_strain
    from tipforce.sensor.contact.force import force_vector as force_vector
    from tipforce.sensor.contact.redundancy import detect as detect
    from tipforce.sensor.contact.redundancy import parity as parity
    from tipforce.sensor.dynamics.first_order_hold import node_coefficients as node_coefficients
    from tipforce.sensor.dynamics.first_order_hold import respond as respond
    from tipforce.sensor.dynamics.model import STEEL_DENSITY as STEEL_DENSITY
    from tipforce.sensor.dynamics.model import modes as modes
    from tipforce.sensor.structure.gauge_shift import strain_row as strain_row
    from tipforce.sensor.structure.geometry import FABRICATED as FABRICATED
    from tipforce.sensor.structure.geometry import Geometry as Geometry
    from tipforce.sensor.structure.layouts import LAYOUTS as LAYOUTS
    from tipforce.sensor.structure.layouts import layout as layout
    from tipforce.sensor.structure.limits import closing_load as closing_load
    from tipforce.sensor.structure.off_axis import apparent_force as apparent_force
    from tipforce.sensor.structure.off_axis import off_axis_wrenches as off_axis_wrenches
    from tipforce.sensor.structure.strain import calibration_matrix as calibration_matrix
    from tipforce.sensor.structure.strain import condition_number as condition_number
    from tipforce.sensor.structure.strain import noise_gain as noise_gain
    from tipforce.sensor.structure.strain import strain_matrix as strain_matrix

_MODULES = {
    "Geometry": "structure.geometry",
    "FABRICATED": "structure.geometry",
    "LAYOUTS": "structure.layouts",
    "layout": "structure.layouts",
    "strain_matrix": "structure.strain",
    "calibration_matrix": "structure.strain",
    "condition_number": "structure.strain",
    "noise_gain": "structure.strain",
    "strain_row": "structure.gauge_shift",
    "apparent_force": "structure.off_axis",
    "off_axis_wrenches": "structure.off_axis",
    "force_vector": "contact.force",
    "force_from_strain": "contact.force",
    "contacts": "contact.estimate",
    "standard_uncertainties": "contact.estimate",
    "first_order_holds": "contact.first_order",
    "curvature": "contact.first_order",
    "parity": "contact.redundancy",
    "detect": "contact.redundancy",
    "fit_calibration": "calibration.fit",
    "Readings": "calibration.data",
    "Model": "calibration.data",
    "Prior": "calibration.data",
    "beam_prior": "calibration.data",
    "Fit": "calibration.result",
    "covariance_of_estimate": "calibration.result",
    "linear_fit": "calibration.fit",
    "simulate": "calibration.simulation",
    "modes": "dynamics.model",
    "STEEL_DENSITY": "dynamics.model",
    "respond": "dynamics.first_order_hold",
    "node_coefficients": "dynamics.first_order_hold",
    "closing_load": "structure.limits",
}
__all__ = [
    "FABRICATED",
    "LAYOUTS",
    "STEEL_DENSITY",
    "Fit",
    "Geometry",
    "Model",
    "Prior",
    "Readings",
    "apparent_force",
    "beam_prior",
    "calibration_matrix",
    "closing_load",
    "condition_number",
    "contacts",
    "covariance_of_estimate",
    "curvature",
    "detect",
    "first_order_holds",
    "fit_calibration",
    "force_from_strain",
    "force_vector",
    "layout",
    "linear_fit",
    "modes",
    "node_coefficients",
    "noise_gain",
    "off_axis_wrenches",
    "parity",
    "respond",
    "simulate",
    "standard_uncertainties",
    "strain_matrix",
    "strain_row",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
