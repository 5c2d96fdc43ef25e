"""The bus configuration of ros2_canopen (bus.yml) for a hand, with the EDS files in the dialect of Lely's dcfgen."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from tipforce.dictionary.eds import eds_text, file_name, lely_dialect
from tipforce.errors import InputError
from tipforce.output_file import BUS_CONFIGURATION, EDS, Kind, write_files
from tipforce_robots.ros2.bridge import ros_name

if TYPE_CHECKING:
    from tipforce.host.hand.file import HandFile

_MASTER_NODE_ID = 127
_HEAD = """\
options:
  dcf_path: "@BUS_CONFIG_PATH@"

master:
  node_id: {master}
  driver: "ros2_canopen::MasterDriver"
  package: "canopen_master_driver"
  sync_period: {sync_us}
"""
_FINGER = """
{name}:
  node_id: {node_id}
  dcf: {eds}
  driver: "ros2_canopen::ProxyDriver"
  package: "canopen_proxy_driver"
  heartbeat_producer: {heartbeat_ms}
"""


def write_ros2_bus(hand: HandFile, folder: Path) -> list[Path]:
    """Write bus.yml and an EDS for each number of gauges; return the paths.

    ``sync_period`` is in microseconds; 0: another device sends the SYNC. Raises InputError if the folder cannot be
    written or holds other files of these names, WriteError, and InputError for a finger with the node-id of the master.
    """
    if _MASTER_NODE_ID in hand.node_ids:
        raise InputError(f"node-id {_MASTER_NODE_ID}: the master of the bus has it; give the finger another one")
    sync_hz = hand.hand.sync_hz
    text = _HEAD.format(master=_MASTER_NODE_ID, sync_us=round(1e6 / sync_hz) if sync_hz else 0)
    files: dict[str, tuple[str, Kind]] = {}
    for finger in hand.finger:
        eds = file_name(finger.gauges)
        files[eds] = lely_dialect(eds_text(finger.gauges)), EDS
        name, beat_ms = ros_name(finger.name, finger.node_id), hand.hand.heartbeat_ms
        text += _FINGER.format(name=name, node_id=finger.node_id, eds=json.dumps(eds), heartbeat_ms=beat_ms)
    return write_files(folder, files | {"bus.yml": (text, BUS_CONFIGURATION)})
