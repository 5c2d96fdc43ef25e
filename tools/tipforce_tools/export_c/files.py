"""What `tipforce export c` writes: the dictionary for so many gauges, and the estimator as it lies in this folder."""

from __future__ import annotations

from pathlib import Path

from tipforce.dictionary import table
from tipforce.output_file import C_SOURCE, make_folder, write_file
from tipforce_tools.export_c import dictionary

HERE = Path(__file__).parent
ESTIMATOR = (
    "tipforce_estimator.h", "tipforce_status.c", "tipforce_float.c", "tipforce_fixed.c", "tipforce_fixed_setup.c",
    "tipforce_judge.h", "tipforce_judge.c",
)  # fmt: skip


def c_files(n: int = 3, converter: table.Converter = table.CONVERTER_16) -> dict[str, str]:
    """The text of each file by its name. Raises InputError for an ``n`` outside 3..8."""
    generated = {
        "tipforce_od.h": dictionary.header_text(n, converter),
        "tipforce_od.c": dictionary.table_text(n, converter),
    }
    return generated | {name: (HERE / name).read_text(encoding="ascii") for name in ESTIMATOR}


def write_c_files(folder: Path, n: int, converter: table.Converter = table.CONVERTER_16) -> list[Path]:
    """Write them into ``folder``, which is created if it is missing. Raises InputError, WriteError."""
    texts = c_files(n, converter)
    make_folder(folder)
    for name, text in texts.items():
        write_file(folder / name, text, C_SOURCE)
    return [folder / name for name in texts]
