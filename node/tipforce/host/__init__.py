"""Host library: hands, nodes, calibration and measurement files, decoders, and a simulated faulty bus."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from tipforce.host.configuration.calibration import write_calibration as write_calibration
    from tipforce.host.configuration.configuration_file import apply_configuration as apply_configuration
    from tipforce.host.configuration.configuration_file import apply_configuration_async as apply_configuration_async
    from tipforce.host.configuration.configuration_file import read_configuration as read_configuration
    from tipforce.host.configuration.configuration_file import verify_configuration as verify_configuration
    from tipforce.host.configuration.configuration_file import verify_configuration_async as verify_configuration_async
    from tipforce.host.configuration.measurements import Measurements as Measurements
    from tipforce.host.configuration.measurements import read_measurements as read_measurements
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
    from tipforce.host.hand.polled import HandSample as HandSample
    from tipforce.host.hand.polled import PolledHand as PolledHand
    from tipforce.host.hand.rows import HandRows as HandRows
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
    from tipforce.samples.record import Rows as Rows
else:
    __getattr__, __dir__, __all__ = lazy(globals())
