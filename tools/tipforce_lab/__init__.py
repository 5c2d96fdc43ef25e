"""Studies of the sensor: design, impacts, integrators, finite elements, error budgets, and the report."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce_lab.design.error_budget import budget as budget
    from tipforce_lab.design.paper_figures import shift_to_reach as shift_to_reach
    from tipforce_lab.design.tables import condition_numbers_by_unit as condition_numbers_by_unit
    from tipforce_lab.design.tables import shared_gauge_disagreement as shared_gauge_disagreement
    from tipforce_lab.design.tables import table_1 as table_1
    from tipforce_lab.design.tables import table_2 as table_2
    from tipforce_lab.design.tables import table_3 as table_3
    from tipforce_lab.dynamics.impact import Striker as Striker
    from tipforce_lab.dynamics.impact import impact as impact
    from tipforce_lab.dynamics.impact import overload as overload
    from tipforce_lab.dynamics.integrators import rk4_stability_limit as rk4_stability_limit
    from tipforce_lab.dynamics.sampling import frequency_of_error as frequency_of_error
    from tipforce_lab.dynamics.slit import slit_stop as slit_stop

_MODULES = {
    "budget": "design.error_budget",
    "shared_gauge_disagreement": "design.tables",
    "shift_to_reach": "design.paper_figures",
    "condition_numbers_by_unit": "design.tables",
    "table_1": "design.tables",
    "table_2": "design.tables",
    "table_3": "design.tables",
    "Striker": "dynamics.impact",
    "impact": "dynamics.impact",
    "overload": "dynamics.impact",
    "rk4_stability_limit": "dynamics.integrators",
    "frequency_of_error": "dynamics.sampling",
    "slit_stop": "dynamics.slit",
}
__all__ = [
    "Striker",
    "budget",
    "condition_numbers_by_unit",
    "frequency_of_error",
    "impact",
    "overload",
    "rk4_stability_limit",
    "shared_gauge_disagreement",
    "shift_to_reach",
    "slit_stop",
    "table_1",
    "table_2",
    "table_3",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
