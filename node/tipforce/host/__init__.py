"""Host library: hands, nodes, calibration and measurement files, decoders, and a simulated faulty bus."""

from tipforce._lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.host.configuration.calibration_file import FitRecord as FitRecord
    from tipforce.host.configuration.calibration_file import fit_record as fit_record
    from tipforce.host.configuration.calibration_file import read_fit as read_fit
    from tipforce.host.configuration.calibration_file import write_calibration as write_calibration
    from tipforce.host.configuration.configuration_file import apply_configuration as apply_configuration
    from tipforce.host.configuration.configuration_file import apply_configuration_async as apply_configuration_async
    from tipforce.host.configuration.configuration_file import read_configuration as read_configuration
    from tipforce.host.configuration.configuration_file import verify_configuration as verify_configuration
    from tipforce.host.configuration.configuration_file import verify_configuration_async as verify_configuration_async
    from tipforce.host.configuration.measurements import Measurements as Measurements
    from tipforce.host.configuration.measurements import read_measurements as read_measurements
    from tipforce.host.configuration.measurements import write_measurements as write_measurements
    from tipforce.host.decoding.decoder import Decoder as Decoder
    from tipforce.host.decoding.decoder import Samples as Samples
    from tipforce.host.frames.frame_array import FRAME as FRAME
    from tipforce.host.frames.frame_array import frame_array as frame_array
    from tipforce.host.hand.bring_up import FingerReport as FingerReport
    from tipforce.host.hand.events import Event as Event
    from tipforce.host.hand.file import FingerPlan as FingerPlan
    from tipforce.host.hand.file import HandFile as HandFile
    from tipforce.host.hand.file import HandPlan as HandPlan
    from tipforce.host.hand.file import read_hand as read_hand
    from tipforce.host.hand.hand import Statistics as Statistics
    from tipforce.host.hand.hand_row import HandRows as HandRows
    from tipforce.host.hand.polled import HandSample as HandSample
    from tipforce.host.hand.polled import PolledHand as PolledHand
    from tipforce.host.hand.rows import Rows as Rows
    from tipforce.host.live.receive import open_receiver as open_receiver
    from tipforce.host.live.receiver import Receiver as Receiver
    from tipforce.host.logs.reader import LogReader as LogReader
    from tipforce.host.logs.reader import open_log as open_log
    from tipforce.host.network.bus_load import Budget as Budget
    from tipforce.host.network.bus_load import hand_budget as hand_budget
    from tipforce.host.network.faulty_bus import Faults as Faults
    from tipforce.host.network.faulty_bus import FaultyBus as FaultyBus
    from tipforce.host.network.faulty_bus import quiet as quiet
    from tipforce.host.network.find import FoundNode as FoundNode
    from tipforce.host.network.finger import Identity as Identity
    from tipforce.host.network.finger import Tare as Tare
    from tipforce.host.network.sdo import SdoChannel as SdoChannel

_MODULES = {
    "Event": "hand.events",
    "FingerReport": "hand.bring_up",
    "FingerPlan": "hand.file",
    "HandFile": "hand.file",
    "HandPlan": "hand.file",
    "read_hand": "hand.file",
    "HandRows": "hand.hand_row",
    "Rows": "hand.rows",
    "Statistics": "hand.hand",
    "PolledHand": "hand.polled",
    "HandSample": "hand.polled",
    "FoundNode": "network.find",
    "Identity": "network.finger",
    "Tare": "network.finger",
    "SdoChannel": "network.sdo",
    "Budget": "network.bus_load",
    "hand_budget": "network.bus_load",
    "Faults": "network.faulty_bus",
    "FaultyBus": "network.faulty_bus",
    "quiet": "network.faulty_bus",
    "Decoder": "decoding.decoder",
    "Samples": "decoding.decoder",
    "frame_array": "frames.frame_array",
    "FRAME": "frames.frame_array",
    "open_log": "logs.reader",
    "LogReader": "logs.reader",
    "open_receiver": "live.receive",
    "Receiver": "live.receiver",
    "Measurements": "configuration.measurements",
    "read_measurements": "configuration.measurements",
    "write_measurements": "configuration.measurements",
    "FitRecord": "configuration.calibration_file",
    "read_fit": "configuration.calibration_file",
    "fit_record": "configuration.calibration_file",
    "write_calibration": "configuration.calibration_file",
    "read_configuration": "configuration.configuration_file",
    "apply_configuration": "configuration.configuration_file",
    "apply_configuration_async": "configuration.configuration_file",
    "verify_configuration": "configuration.configuration_file",
    "verify_configuration_async": "configuration.configuration_file",
}
__all__ = [
    "FRAME",
    "Budget",
    "Decoder",
    "Event",
    "Faults",
    "FaultyBus",
    "FingerPlan",
    "FingerReport",
    "FitRecord",
    "FoundNode",
    "HandFile",
    "HandPlan",
    "HandRows",
    "HandSample",
    "Identity",
    "LogReader",
    "Measurements",
    "PolledHand",
    "Receiver",
    "Rows",
    "Samples",
    "SdoChannel",
    "Statistics",
    "Tare",
    "apply_configuration",
    "apply_configuration_async",
    "fit_record",
    "frame_array",
    "hand_budget",
    "open_log",
    "open_receiver",
    "quiet",
    "read_configuration",
    "read_fit",
    "read_hand",
    "read_measurements",
    "verify_configuration",
    "verify_configuration_async",
    "write_calibration",
    "write_measurements",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy(__name__, _MODULES)
