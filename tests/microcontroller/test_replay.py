"""The recorded conversations with the firmware: its drivers, its loop and its flash on CPython and on MicroPython."""

from pathlib import Path

import pytest

import firmware
import tipforce_loader
from microcontroller import talk
from micropython import engine, scripts
from micropython.recording import Recording

FOLDER, LOADER = Path(str(firmware.__file__)).parent, Path(str(tipforce_loader.__file__)).parent
HERE = Path(__file__).parent
# Every converter and every controller; all conversations but the two that need a simulated front end or a stored EDS.
PAIRS = {
    ("nau7802", "mcp2515"): (scripts.nmt_and_sdo, scripts.calibration, scripts.measurement, scripts.network),
    ("ads1220", "machine"): (scripts.pdos, scripts.network, scripts.many_gauges, scripts.filters),
    ("hx711", "pyb"): (scripts.measurement, scripts.lss),
}  # fmt: skip


def firmware_files() -> dict[str, bytes]:
    """The firmware, the loader and the fakes, by their place on MicroPython."""
    own = [path for folder in (FOLDER, LOADER) for path in sorted(folder.glob("*.py")) if path.name != "build.py"]
    found = {f"{engine.LIBRARY}/{path.parent.name}/{path.name}": path.read_bytes() for path in own}
    names = "fakes.py", "fake_controllers.py", "rig.py"
    found |= {f"{engine.LIBRARY}/microcontroller/{name}": (HERE / name).read_bytes() for name in names}
    return found


@pytest.fixture(scope="module")
def spoken() -> list[Recording]:
    return [one for (adc, can), wanted in PAIRS.items() for one in talk.spoken(adc, can, wanted)]


def test_conversations(spoken: list[Recording]) -> None:
    assert sum(sum(one.frames()) for one in spoken) > 5000
    talk.assert_same(spoken, engine.sources() | firmware_files())


def test_the_conversations_reach_what_the_firmware_adds(spoken: list[Recording]) -> None:
    """Gauges were read and showed a contact, controllers failed, converters fell silent, flash was written."""
    for recording in spoken:
        if "measurement" in recording.name:
            contacts = [word for answer in recording.answers for word in answer.split() if word.startswith("285#")]
            assert any(int(word.split("#")[1][12:14], 16) & 3 == 3 for word in contacts), recording.name
            emcy = {word[3:7] for answer in recording.answers for word in answer.split() if word.startswith("85#")}
            assert emcy >= {"3050", "1050"}, recording.name  # front end, gauge saturated
        if "network" in recording.name:
            emcy = {word[3:7] for answer in recording.answers for word in answer.split() if word.startswith("85#")}
            assert emcy >= {"1081", "2081", "4081"}, recording.name  # overrun, passive, back from bus-off
    assert {one.stored != "- -" for one in spoken} == {True, False}
