"""A small share of `python -m bench.eds`: random frames never raise out of a device, whatever its file."""

from pathlib import Path

from bench import eds

from tipforce.machine import shipped_eds


def test_random_frames_never_raise(tmp_path: Path) -> None:
    path = tmp_path / "generated.eds"
    path.write_text(eds.generated_eds(60))
    for one in (path, shipped_eds("cia402")):
        assert eds.fuzz(one, 2000, seed=17) > 500
