"""Physics of the sensor, without CAN: geometry, strain, force, contact, calibration, dynamics."""

from canopen_device.lazy import lazy

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
    from tipforce.sensor.contact.estimate import force_from_strain as force_from_strain
    from tipforce.sensor.contact.estimate import force_vector as force_vector
    from tipforce.sensor.contact.estimate import standard_uncertainties as standard_uncertainties
    from tipforce.sensor.contact.redundancy import detect as detect
    from tipforce.sensor.contact.redundancy import parity as parity
    from tipforce.sensor.contact.validity import curvature as curvature
    from tipforce.sensor.contact.validity import first_order_holds as first_order_holds
    from tipforce.sensor.dynamics.first_order_hold import node_coefficients as node_coefficients
    from tipforce.sensor.dynamics.first_order_hold import respond as respond
    from tipforce.sensor.dynamics.model import STEEL_DENSITY as STEEL_DENSITY
    from tipforce.sensor.dynamics.model import modes as modes
    from tipforce.sensor.structure.layouts import LAYOUTS as LAYOUTS
    from tipforce.sensor.structure.layouts import layout as layout
    from tipforce.sensor.structure.off_axis import apparent_force as apparent_force
    from tipforce.sensor.structure.off_axis import off_axis_wrenches as off_axis_wrenches
    from tipforce.sensor.structure.plane_frame import closing_load as closing_load
    from tipforce.sensor.structure.quality import condition_number as condition_number
    from tipforce.sensor.structure.quality import noise_gain as noise_gain
    from tipforce.sensor.structure.strain import FABRICATED as FABRICATED
    from tipforce.sensor.structure.strain import Geometry as Geometry
    from tipforce.sensor.structure.strain import calibration_matrix as calibration_matrix
    from tipforce.sensor.structure.strain import strain_matrix as strain_matrix
    from tipforce.sensor.structure.strain import strain_row as strain_row
else:
    __getattr__, __dir__, __all__ = lazy(globals())
