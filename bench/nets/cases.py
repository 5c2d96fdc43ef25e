"""The command lines whose outputs are compared: those of cases.txt, and the same ones for each log."""

from __future__ import annotations

from pathlib import Path

SEQUENCES, SEQUENCES_IN_CASE = 10_000, 500
COMMANDS = (
    "demo node run simulate scan read sdo hand nmt lss firmware|show firmware|install config calibrate|fit "
    "calibrate|apply calibrate|guide calibrate|verify calibrate|budget tare estimate dump decode "
    "dataset|show dataset|verify dataset|compact dataset|sql log replay plot monitor view ros2 "
    "design|table design|sweep design|optimise report conformance export doctor vcan"
)
LAYOUTS = {
    "remapped": "--dcf in/made/remapped-5.dcf",
    "devices": "--eds 7=in/lamp.eds --eds 6=in/drive.eds",
    **{f"gauges{n}": f"--dcf in/made/gauges{n}-5.dcf --dcf in/made/gauges{n}-6.dcf" for n in range(4, 9)},
}
LOGS = (
    "one contact unnumbered numbered restarted events remapped quiet midnight devices strange bad back screen foreign "
    "made/grasp made/dying made/scene gauges4 gauges5 gauges6 gauges7 gauges8"
)
OTHER_FORMATS = (
    "one.log.gz one.log.zst one.asc one.blf one.csv one.trc one.db numbered.pcap cut.log.gz made/one.mcap part-2.log"
)
_OF_LOG = """
decode {log} {flags} -o o.csv
decode {log} {flags} -o o.jsonl --json
decode {log} {flags} -o o.parquet -q
decode {log} {flags} -o o.mcap -q
decode {log} {flags} --summary -v
decode {log} --summary --json
dump {log} --decode --json {eds}
monitor {log} --json --interval 0.05 {eds}
monitor {log} --once 0.5 {eds}
"""


def _of_log(name: str) -> str:
    flags = LAYOUTS.get(name, "")
    eds = flags if "--eds" in flags else f"--gauges {name[6]}" if name.startswith("gauges") else ""
    return _OF_LOG.format(log=f"in/{name}.log", flags=flags, eds=eds)


CASES = {f"log-{name.replace('/', '-')}": _of_log(name) for name in LOGS.split()}
for _name in OTHER_FORMATS.split():
    CASES[f"format-{_name.replace('/', '-')}"] = f"decode in/{_name} -o o.csv\ndecode in/{_name} --summary --json"
for _first in range(0, SEQUENCES, SEQUENCES_IN_CASE):
    CASES[f"rows-{_first:05}"] = f"@rows {_first} {SEQUENCES_IN_CASE}"
CASES["help"] = "\n".join(["--help", "--version", *(f"{name.replace('|', ' ')} --help" for name in COMMANDS.split())])
for _block in Path(__file__).with_name("cases.txt").read_text().split("\n== ")[1:]:
    CASES[_block.partition("\n")[0]] = _block.partition("\n")[2]
