"""Studies of the sensor: design, impacts, integrators, finite elements, error budgets, and the report."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce_lab.design.error_budget import budget as budget
    from tipforce_lab.design.sections import shift_to_reach as shift_to_reach
    from tipforce_lab.design.tables import condition_numbers_by_unit as condition_numbers_by_unit
    from tipforce_lab.design.tables import shared_gauge_disagreement as shared_gauge_disagreement
    from tipforce_lab.design.tables import table_1 as table_1
    from tipforce_lab.design.tables import table_2 as table_2
    from tipforce_lab.design.tables import table_3 as table_3
    from tipforce_lab.dynamics.impact import Striker as Striker
    from tipforce_lab.dynamics.impact import impact as impact
    from tipforce_lab.dynamics.impact import overload as overload
    from tipforce_lab.dynamics.integrators import frequency_of_error as frequency_of_error
    from tipforce_lab.dynamics.integrators import rk4_stability_limit as rk4_stability_limit
    from tipforce_lab.dynamics.switched import slit_stop as slit_stop
else:
    __getattr__, __dir__, __all__ = lazy(globals())
