"""Which files a node needs on MicroPython: the whole device core, and nothing of a PC."""

from micropython import engine

# A node is a server; and what devices from an EDS need, a fingertip does without.
OTHER_DEVICES = {f"canopen_device/core/{name}.py" for name in ("__init__", "sdo_client", "sync_producer", "wide_types")}


def test_the_whole_device_core_is_among_them_and_nothing_of_a_pc() -> None:
    found = {path.relative_to(engine.SOURCE).as_posix() for path in engine.on_node_files()}
    assert (
        found
        >= {str(path.relative_to(engine.SOURCE)) for path in engine.SOURCE.glob("canopen_device/core/*.py")}
        - OTHER_DEVICES
    )
    assert not found & OTHER_DEVICES
    assert found >= {f"tipforce/{name}.py" for name in ("dictionary/table", "sensor/contact/scalar", "fingertip/node")}
    assert not [name for name in found if name.startswith("canopen_device/") and "/core/" not in name]
    assert not found & {"tipforce/sensor/contact/estimate.py", "tipforce/errors.py"}
