"""The CANopen stack for fingertip force sensors.

    import tipforce

    with tipforce.open("can0") as bus:              # or an open can.Bus or canopen.Network
        finger = bus.finger(5)                      # node-id 5
        contact = finger.read()                     # the next sample
        print(contact.P_newtons, contact.phi_deg, contact.theta_deg, contact.u_P_newtons, contact.reason)
        print(finger.sdo["calibration.serial"])     # any object, by its dictionary name
        for contact in finger.samples():            # `async for` works too
            ...

- a whole hand: ``Hand.open("hand.toml")``, then ``for row in hand.rows(): row["thumb"].P_newtons``
- a log as arrays: ``read_log("run.log")[5].P_newtons``
- a calibration: ``Calibration.from_microstrain(C, offset, covariance)``, ``Calibration.read("finger.toml")``,
  ``fit_calibration(Readings(...))``; ``finger.apply_calibration(calibration)``; ``estimate(calibration, microstrain)``;
  prepared for many calls: ``estimator = Estimator(calibration)``, then ``estimator(microstrain)``
- fingers for your own tests: ``simulated_finger(5, load=(4.4, 90, 45))``, ``simulated_hand(5)``
- any CANopen device from its EDS or DCF: ``device_from_eds("drive.eds", 5)``; on a bus, for tests of a master:
  ``with simulated_device("drive.eds", 5, bus) as drive: drive[0x6064] = 100``

The public names are those in ``__all__`` here and in ``tipforce.host``, ``tipforce.sensor``, ``tipforce.fingertip``,
``tipforce.sources``, ``tipforce.scene``, ``tipforce_robots.mujoco`` and ``tipforce_robots.learning``, and in
``canopen_device``, ``canopen_device.eds``, ``canopen_device.machine`` and ``canopen_device.running``. They follow
semantic versioning: until 1.0 a minor version may change them, as the changelog states. All else may change without
notice.

Names carry units (``force_newtons``, ``theta_rad``), shapes are written as (n, 3), NaN means unknown. All errors
that tipforce raises on purpose are ``TipforceError``; the message says what to do next."""

from canopen_device.lazy import lazy

TYPE_CHECKING = False
if TYPE_CHECKING:
    from canopen_device.eds.load import EdsWarning as EdsWarning
    from canopen_device.eds.load import device_from_eds as device_from_eds
    from canopen_device.machine.device import SimulatedDevice as SimulatedDevice
    from canopen_device.machine.running import simulated_device as simulated_device
    from tipforce.dictionary.table import SOFTWARE_VERSION as __version__  # noqa: N811
    from tipforce.errors import DuplicateNodeError as DuplicateNodeError
    from tipforce.errors import EnvironmentLackError as EnvironmentLackError
    from tipforce.errors import InputError as InputError
    from tipforce.errors import NoNewSampleError as NoNewSampleError
    from tipforce.errors import NoResponseError as NoResponseError
    from tipforce.errors import RefusedError as RefusedError
    from tipforce.errors import SdoAbortError as SdoAbortError
    from tipforce.errors import TipforceError as TipforceError
    from tipforce.host.configuration.calibration import Calibration as Calibration
    from tipforce.host.decoding.estimator import Contacts as Contacts
    from tipforce.host.decoding.estimator import Estimator as Estimator
    from tipforce.host.decoding.estimator import estimate as estimate
    from tipforce.host.decoding.log import Log as Log
    from tipforce.host.decoding.log import NodeLog as NodeLog
    from tipforce.host.decoding.log import read_log as read_log
    from tipforce.host.hand.hand import Hand as Hand
    from tipforce.host.hand.rows import HandRow as HandRow
    from tipforce.host.network.bus import Bus as Bus
    from tipforce.host.network.bus import open_connection as open
    from tipforce.host.network.finger import Finger as Finger
    from tipforce.samples.contact import Contact as Contact
    from tipforce.samples.reasons import Status as Status
    from tipforce.scene.simulated_bus import SimulatedBus as SimulatedBus
    from tipforce.scene.simulated_bus import simulated_finger as simulated_finger
    from tipforce.scene.simulated_bus import simulated_hand as simulated_hand
    from tipforce.sensor.calibration.data import Readings as Readings
    from tipforce.sensor.calibration.fit import fit_calibration as fit_calibration

    __all__ = ["__version__", "open"]  # "as" exports only what keeps its name
else:
    __getattr__, __dir__, __all__ = lazy(globals())
