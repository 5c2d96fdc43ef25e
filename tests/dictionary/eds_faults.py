"""What is wrong with an EDS or DCF that is written here: by the reader of any EDS, and by what that reader forgives."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from canopen_device.eds.reader import describe
from canopen_device.eds.sections import EdsFile, parse

_SECTION = re.compile(
    r"fileinfo|deviceinfo|devicecomissioning|dummyusage|comments|(mandatory|optional|manufacturer)objects"
    r"|[0-9a-f]{4}(sub[0-9a-f]{1,2})?"
)
_FORMS = {
    "fileinfo": {
        "CreationDate": r"\d\d-\d\d-\d{4}",
        "CreationTime": r"(0\d|1[0-2]):\d\d[AP]M",
        "EDSVersion": r"[34]\.0",
    },
    "deviceinfo": {"VendorNumber": r"0x[0-9A-F]{8}"},
    "dummyusage": {f"Dummy000{k}": r"[01]" for k in range(1, 8)},
}


def eds_faults(text: str) -> list[str]:
    """Every fault in words; empty for a file that any tool reads as it is meant."""
    path = Path("node.dcf" if "[DeviceComissioning]" in text else "node.eds")
    file = parse(text, path)
    return [
        *_forgiven(file),
        *(
            finding.text
            for finding in describe(file, path, text.encode(), 5 if path.suffix == ".eds" else None).findings
        ),
    ]


def _forgiven(file: EdsFile) -> Iterator[str]:
    names: dict[str, Counter[str]] = {}
    for name, section in file.sections.items():
        if not _SECTION.fullmatch(name):
            yield f"[{section.name}]: not a section of CiA 306"
        for key, form in _FORMS.get(name, {}).items():
            if not re.fullmatch(form, section.get(key) or ""):
                yield f"[{section.name}] {key}={section.get(key)}: the form is {form}"
        numbers = [key for key in section.keys if key.isdigit()]
        if name.endswith("objects") and numbers != [str(k + 1) for k in range(len(numbers))]:
            yield f"[{section.name}]: its keys do not count from 1"
        if name == "comments" and int(section.get("Lines") or 0) != len(section.keys) - 1:
            yield f"[{section.name}] Lines={section.get('Lines')}"
        if section.get("ParameterName"):
            names.setdefault(name.partition("sub")[0] if "sub" in name else "", Counter())[
                section.get("ParameterName") or ""
            ] += 1
        if (section.get("PDOMapping") or "0") not in ("0", "1"):
            yield f"[{section.name}] PDOMapping={section.get('PDOMapping')}"
    yield from (f"{name}: {count} times" for used in names.values() for name, count in used.items() if count > 1)
