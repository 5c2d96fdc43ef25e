"""Wrong inputs: one line that names the place and the next step, and the documented exit code."""

from pathlib import Path

import numpy as np
import pytest

from host.bus_with_nodes import connected, finger, new_channel
from tipforce.host.configuration.calibration import write_calibration
from tipforce.host.configuration.measurements import write_measurements
from tipforce.scene import beam_calibration
from tipforce.sensor.calibration.simulation import simulate
from tools.rig import Tipforce
from tools.test_calibrate_fit import measured

LOG = "".join(f"({1700000000 + k / 1000:.6f}) vcan0 285#2E1129239A1103{k:02X}\n" for k in range(50))
EXTENDED = "".join(f"(1700000000.{k:06d}) can0 18FEF1{k:02X}#0102030405060708\n" for k in range(40))
FILES = {
    "run.log": LOG,
    "j1939.log": EXTENDED,
    "other.log": EXTENDED.replace("18FEF1", "3"),
    "prose.txt": "these are no frames\n",
    "broken.blf": "XXXX" + 200 * "x",
    "noise.asc": "\x01\x02\x03",
    "bad.toml": "[hand\n",
    "empty.toml": "",
    "hand.toml": '[[finger]]\nnode_id = 1\ncalibration = "none.toml"\n',
    "one.toml": "[[finger]]\nnode_id = 1\n",
    "taken/bus.yml": "routes: 12\n",
    "twice.toml": "[[finger]]\nnode_id = 1\n[[finger]]\nnode_id = 1\n",
    "scene.toml": "duration_s = -1\n",
    "readings.csv": "SG1,SG2,SG3\n1,2,3\n",
    "two.csv": "SG1,SG2\n1,2\n",
    "si.csv": "SG1,SG2,SG3,P_N,phi_deg,theta_deg\n",
    "objects.toml": '[objects]\n"heartbeat.producer_sm" = 1\n',
    "layout.toml": 'points = ["K_H", "S_H"]\n',
    "empty.dcf": "",
    "much.toml": '[objects]\n"interrupt_delta:1" = "much"\n',
    "unknown.toml": '[objects]\n"contact_unknown" = 1\n',
    "minus.toml": '[objects]\n"tpdo3.cob_id" = "$NODEID-1"\n',
    "zero-hand.toml": '[[finger]]\nnode_id = 5\ncalibration = "zero.toml"\n',
    "zero-scene.toml": (
        'duration_s = 1.0\nsync_hz = 100\n[[nodes]]\nids = [5]\npdos = ["contact"]\ncalibration = "zero.toml"\n'
    ),
    "four.csv": "SG1,SG2,SG3,SG4\n1,2,3,4\n",
    "five.toml": 'points = ["K_H", "S_H", "U", "T", "L"]',
    "untimed.log": "  vcan0  285   [8]  2E 11 29 23 9A 11 03 03\n",
    "leap.log": "(0000000001.000000) can0 285#E80364006400030A\n(1700000000.000000) can0 285#E80364006400030B\n",
    "node.toml": "duration_s = 1\n[[node]]\n",
    "static.toml": (Path(__file__).parents[2] / "scenes" / "static.toml").read_text(),
}
NO_SENSOR = {  # calibrations that no sensor can have: matrix, variance and covariance of SG1 with SG2, what is said
    "zero": ("[[0.0, 0, 0], [0, 0, 0], [0, 0, 0]]", 0.25, 0, "rank below 3"),
    "flat": ("[[1e4, 0, 0], [0, 1e4, 0], [1e4, 1e4, 0]]", 0.25, 0, "rank below 3"),
    "nan": ("[[nan, 0, 0], [0, 1e4, 0], [0, 0, 1e4]]", 0.25, 0, "nan is not finite"),
    "micro": ("[[1e-2, 0, 0], [0, 1e-2, 0], [0, 0, 1e-2]]", 0.25, 0, "newtons per microstrain: multiply"),
    "converted": ("[[1e10, 0, 0], [0, 1e10, 0], [0, 0, 1e10]]", 0.25, 0, "converted twice"),
    "grams": (
        "[[1e6, 0, 0], [0, 1e6, 0], [0, 0, 1e6]]",
        0.25,
        0,
        "loads look like grams: multiply the matrix by 0.0098",
    ),
    "quiet": ("[[1e4, 0, 0], [0, 1e4, 0], [0, 0, 1e4]]", 0.0, 0, "variance is 0: allowed is above 0"),
    "indefinite": ("[[1e4, 0, 0], [0, 1e4, 0], [0, 0, 1e4]]", 0.25, 0.3, "not positive semi-definite"),
}
for _name, (_matrix, _variance, _covariance, _) in NO_SENSOR.items():
    FILES[f"{_name}.toml"] = (
        f"[calibration]\nmatrix_newtons_per_strain = {_matrix}\noffset_microstrain = [0, 0, 0]\nload_sense = 'push'\n"
        f"covariance_microstrain2 = [[{_variance}, {_covariance}, 0], [{_covariance}, 0.25, 0], [0, 0, 0.25]]\n"
    )
NOBODY = "-i virtual -c nobody --timeout 0.01 --retries 0"
NODE = "node --node-id 5 -i virtual -c x"
NO_LOG = "prose.txt: no frames in it; is it a log? line 1: 'these are no frames'"
NO_BUS = "no bus given: no CAN interface here; use -i and -c, as in -i slcan -c /dev/ttyACM0"

WRONG: list[tuple[str, int, str]] = [
    # usage
    ("dumb", 2, "'dumb' is not a command; did you mean dump"),
    ("scna", 2, "did you mean scan?"),
    ("calibrat", 2, "did you mean calibrate?"),
    ("--compeltion bash", 2, "did you mean --completion?"),
    ("sdo raed 5 P", 2, "did you mean read?"),
    ("calibrate appyl x.toml", 2, "did you mean apply?"),
    ("scan --wiat 5", 2, "did you mean --wait"),
    ("decode --sumary run.log", 2, "did you mean --summary?"),
    ("DEMO!", 2, "commands: demo, run, vcan"),
    ("--json", 2, "commands: demo, run, vcan"),
    ("read 5 --wait 0 -i virtual -c x", 2, "--wait: '0': allowed is a time over 0 s"),
    ("export ros2 -o x", 2, "--hand: "),
    ("export ros2 --hand one.toml", 2, "--output: "),
    ("export c --programs -o x", 2, "the exported C has no program slots"),
    ("decode --from yesterday run.log", 2, "allowed are seconds from the start"),
    ("decode --gauges 9 run.log", 2, "--gauges"),
    ("decode --signals Q run.log", 2, "no message has the signal Q: allowed are"),
    ("decode --jobs 0 run.log", 2, "--jobs: '0': allowed are whole numbers from 1"),
    ("decode --resample -5 run.log", 2, "--resample"),
    ("decode --resample 1e9 run.log", 2, "choose a lower rate"),
    ("decode --dcf empty.dcf run.log", 2, "no [section] in it"),
    ("decode run.log -o out.xyz", 2, "unknown suffix: allowed are"),
    ("decode run.log --format parquet", 2, "needs --output FILE"),
    ("decode none.log", 2, "none.log: no such file"),
    ("decode none/*.log", 2, "no file matches"),
    ("decode . ", 2, "is a directory; name its logs"),
    ("decode - run.log", 2, "stdin cannot be decoded together with files"),
    ("decode --calibration none.toml run.log", 2, "none.toml: No such file"),
    ("decode --dbc none.dbc run.log", 2, "none.dbc"),
    ("dump any,18G:7FF run.log", 2, "filter '18G:7FF'"),
    ("dump none.log", 2, "none.log: no such file"),
    ("dump -L -e run.log", 2, "leave one out"),
    ("plot run.log", 2, "add -o FILE.png"),
    ("plot run.log -o x.doc", 2, "allowed are the suffixes"),
    ("plot run.log -o none/x.svg", 2, "create it first"),
    ("replay none.log -i virtual -c x", 2, "none.log"),
    (f"sdo read 5 heartbeat.producer {NOBODY}", 2, "close to it: heartbeat.producer_ms"),
    (f"sdo read 5 0x1018 {NOBODY}", 2, "has several sub-indices"),
    (f"sdo read 5 0x1018:09 {NOBODY}", 2, "no sub-index 9"),
    ("nmt start 5-1 -i virtual", 2, "the second is smaller"),
    ("nmt begin 5 -i virtual", 2, "invalid choice: 'begin'"),
    ("tare 5 --clear --show -i virtual", 2, "not allowed with argument"),
    ("scan -i nonsense", 2, "invalid choice: 'nonsense'"),
    ("scan --wait -1 -i virtual -c x", 2, "--wait: '-1': allowed is 0 s or more"),
    ("read 5 -n x -i virtual", 2, "allowed are whole numbers from 1"),
    ("config show 5 x.toml -i virtual", 2, "takes no FILE"),
    (f"config apply 5 objects.toml {NOBODY}", 2, "close to it: heartbeat.producer_ms"),
    ("hand run none.toml", 2, "none.toml"),
    ("hand run bad.toml", 2, "bad.toml"),
    ("hand check twice.toml", 2, "node_id"),
    ("hand check hand.toml", 2, "none.toml"),
    ("hand run hand.toml --seconds 0", 2, "--seconds: '0': allowed are seconds, more than 0"),
    ("run none.toml", 2, "none.toml"),
    ("run scene.toml", 2, "duration_s"),
    ("run empty.toml", 2, "empty.toml"),
    ("calibrate fit none.csv", 2, "none.csv: No such file"),
    ("calibrate fit prose.txt", 2, "prose.txt"),
    ("calibrate fit si.csv", 2, "si.csv"),
    ("calibrate verify hand.toml --node 5 -i virtual -c x", 2, "hand.toml"),
    ("estimate hand.toml readings.csv", 2, "hand.toml"),
    ("estimate cal.toml two.csv", 2, "allowed are SG1 to SGn without a gap, n = 3 to 8"),
    ("estimate cal.toml readings.csv -o readings.csv", 2, "is also an input; choose another name"),
    ("estimate cal.toml none.csv", 2, "none.csv: No such file"),
    ("calibrate budget cal.toml --phi 10", 2, "one load needs both"),
    ("design sweep h2 --layout layout.toml", 2, "layout"),
    ("export dcf", 2, "add it, for example --node-id 5"),
    ("export c", 2, "name a folder"),
    ("export eds --gauges 2", 2, "allowed 3 to 8"),
    ("log -o none/x.log -i virtual -c x", 2, "the directory none does not exist; create it first"),
    ("report -o run.log", 2, "is a file; name a directory"),
    ("view none.log", 2, "none.log"),
    ("view run.log --from 100", 2, "no sample between --from and --to; the log lasts 0.049 s"),
    ("view run.log --from nan", 2, "--from nan: allowed is 0 to 1e+09 s"),
    ("view run.log --port 70000", 2, "--port 70000: allowed are 0"),
    ("doctor --listen -1", 2, "'-1': allowed are 0 to 3600 s"),
    ("design optimise --seed -1", 2, "allowed are whole numbers from 0"),
    ("calibrate budget --load 1e300", 2, "--load: '1e300': allowed is 1e-09 to 1e+09 N"),
    ("calibrate budget --noise 1e300", 2, "--noise: '1e300': allowed is 0 to 1e+09"),
    ("export c -o run.log", 2, "is a file; name a directory"),
    ("export ros2 --hand one.toml -o taken", 2, "the existing file is not a bus.yml of ros2_canopen"),
    ("dump ,181:7FF -", 2, "no channel"),
    ("dump - -", 2, "only one"),
    ("dump -L -a -", 2, "-L and -a"),
    ("dump -ta untimed.log", 2, "no timestamps"),
    ("log -o run.log -i virtual -c x", 2, "run.log exists"),
    *((f"log -o {name} -i virtual -c x", 2, "allowed are .asc, ") for name in ("run.xyz", "run.blf.gz", "run")),
    ("log run.log -i virtual -c x", 2, "allowed are buses"),
    ("replay none.blf -i virtual -c x", 2, "none.blf: No such file"),
    ("replay broken.blf -i virtual -c x", 2, "tipforce: broken.blf: "),
    ("replay untimed.log -i virtual -c x", 2, "no timestamps"),
    ("replay - --loop 2 -i virtual -c x", 2, "stdin can be read only once"),
    ("replay run.log a=b -i virtual -c x", 2, "allowed is one of them"),
    ("replay run.log --speed 0", 2, "--speed: '0': allowed are numbers over 0, and inf"),
    ("replay run.log --max-gap -1", 2, "--max-gap: '-1': allowed are 0 or more seconds"),
    ("replay run.log vcan0 -i virtual", 2, "vcan0"),
    ("monitor --speed 1 -i virtual -c x", 2, "--follow and --speed: need a log"),
    ("monitor run.log can0", 2, "--nodes selects from a log"),
    ("monitor none.log", 2, "no such file"),
    *((f"monitor x.log {words}", 2, "allowed") for words in ("--once 0", "--once x", "--interval nan", "--speed 0")),
    ("plot none.log -o x.png", 2, "no such file"),
    ("plot run.log -o x.png --signals Q", 2, "no message has the signal Q"),
    ("plot run.log -o x.png --nodes 77", 2, "with --nodes), so there is nothing to draw"),
    ("plot untimed.log -o x.png", 2, "no timestamps"),
    ("plot run.log -o run.log", 2, "allowed are the suffixes .svg, .png, .pdf"),
    *(
        (f"plot run.log -o x.png --size {size}", 2, "allowed are 16x10cm, 160x100mm or 7x4in")
        for size in ("10", "0x5", "10x10furlong", "1000x1000", "x")
    ),
    ("decode --resample 0 run.log", 2, "--resample"),
    ("decode --resample 1000 leap.log -o x.csv", 2, "intervals without a sample"),
    ("decode --calibration 999=a.toml run.log", 2, "999"),
    ("decode --dcf none.dcf run.log", 2, "none.dcf"),
    ("decode --scheduler tcp://127.0.0.1:1 run.log", 2, "--scheduler"),
    ("decode run.log -o run.log --format csv", 2, "run.log: is also an input"),
    ("decode run.log -o readings.csv --format jsonl", 2, "readings.csv: the existing file is not a JSON lines file"),
    ("estimate cal.toml four.csv", 2, "4 gauges, the calibration"),
    ("estimate cal.toml readings.csv --saturation -5", 2, "--saturation: '-5': allowed is above 0"),
    ("estimate cal.toml readings.csv -o none/out.csv", 2, "none does not exist; create it first"),
    ("estimate cal.toml readings.csv -o ./link.csv", 2, "link.csv: is also an input"),
    ("estimate cal.toml readings.csv -o cal.toml", 2, "cal.toml: is also an input"),
    *(
        (f"calibrate fit data.csv --saturation none {words}", 2, text)
        for words, text in (
            ("--prior beam", "--prior beam needs --layout"),
            ("--angle-scatter -1", "--angle-scatter: '-1': allowed is 0 to 20 degrees"),
            ("--noise 0", "--noise: '0': allowed is above 0"),
            ("--saturation nan", "--saturation: 'nan': allowed is above 0"),
            ("--serial -1", "'-1': allowed are 0 to 0xFFFFFFFF"),
            ("--layout IV", "layout 'IV'"),
            ("--layout five.toml", "has 5 gauges"),
            ("--no-offset --drift tare", "needs an offset to drift"),
            ("-o data.csv", "data.csv: is also an input"),
            ("-o static.toml", "static.toml: the existing file is not a calibration file"),
        )
    ),
    *(
        (f"calibrate guide --node 5 --auto -q --session s.csv {words} BUS", 2, text)
        for words, text in (
            ("--samples 5", "--samples 5: allowed is 10 to 100000"),
            ("--period 0", "--period: '0': allowed is above 0"),
            ("--max-std nan", "--max-std: 'nan': allowed is above 0"),
            ("--max-drift -1", "--max-drift: '-1': allowed is above 0"),
            ("--plan a.toml --weights 1", "--plan and --weights: allowed is one of them"),
            ("-o none/a.toml", "the directory none does not exist; create it first"),
            ("--session none/a.csv", "the directory does not exist; create it first"),
            ("--layout IV", "layout 'IV'"),
            ("--saturation -3", "--saturation: '-3': allowed is above 0"),
            ("--angle-scatter 30", "--angle-scatter: '30': allowed is 0 to 20 degrees"),
            ("--prior beam", "--prior beam needs --layout"),
            ("--layout five.toml", "five.toml has 5 gauges, the node has 3"),
        )
    ),
    *(
        (f"ros2 {words}", 2, text)
        for words, text in (
            ("--seconds 0", "--seconds 0: allowed is a time over 0"),
            ("--speed 0 run.log", "--speed 0: allowed is more than 0"),
            ("--no-bring-up", "--no-bring-up: needs a hand file"),
            ("--allow-tare run.log", "--allow-tare: needs a hand file that is commissioned"),
            ("--gauges 9", "--gauges 9: allowed are 3 to 8"),
            ("--namespace left-hand", "--namespace 'left-hand': allowed are letters, digits and _"),
            ("--domain 233", "--domain 233: allowed are 0 to 232"),
            ("none.log", "none.log"),
        )
    ),
    *((f"estimate {name}.toml readings.csv", 2, text) for name, (*_, text) in NO_SENSOR.items()),
    *(
        (command, 2, "rank below 3")
        for command in (
            "calibrate budget zero.toml",
            "hand check zero-hand.toml",
            "run zero-scene.toml",
            "decode run.log --calibration zero.toml",
            "calibrate apply zero.toml --node 5 --yes -i virtual -c x",
        )
    ),
    ("run static -o none/x.log", 2, "none does not exist; create it first"),
    ("run node.toml", 2, "node: no such key; did you mean nodes?"),
    ("run node.toml --explain", 2, "node: no such key; did you mean nodes?"),
    ("run static.toml -o static.toml", 2, "static.toml: the existing file is not a candump log"),
    ("export eds -o cal.toml", 2, "cal.toml: the existing file is not an EDS or DCF"),
    ("export eds -o .", 2, "is a directory; name a file"),
    ("design optimise -o cal.toml", 2, "cal.toml: the existing file is not a layout file"),
    ("design sweep r --steps 5 -o r.gif", 2, "allowed are the suffixes .svg, .png"),
    *(
        (f"{command} {words}", 2, words.split()[0])
        for words in ("--host 192.0.2.1", "--host 0.0.0.0 --token auto", "--port 70000", "--token short")
        for command in ("demo --view", "view none.log")
    ),
    *((f"view {words} -i virtual --port 0", 2, "") for words in ("none.toml", "-", "run.log --no-bring-up")),
    # usage of sdo and node
    *(
        (f"sdo {words} {NOBODY}", 2, text)
        for words, text in (
            ("read 0 0x1000 0", "argument ID: node-id '0': allowed are 1 to 127 (10 or 0x0A)"),
            ("read x 0x1000 0", "argument ID: node-id 'x': allowed are 1 to 127 (10 or 0x0A)"),
            ("read 5", "object missing"),
            ("read 5 0x1017 0 u16 5", "'0x1017 0 u16 5': too many words; expected NAME, or INDEX SUB [TYPE]"),
            ("read 5 x 0 u16", "'x' '0' is not INDEX SUB; write 0x1017 0, or one NAME"),
            ("read 5 0x1017 y", "'0x1017' 'y' is not INDEX SUB"),
            ("read 5 0x10000 0 u8", "index 0x10000 sub 0: allowed are 0 to 0xFFFF and 0 to 0xFF"),
            ("read 5 0x1000 256 u8", "sub 256: allowed are"),
            ("read 5 -1 0 u8", "index -1 sub 0: allowed are"),
            ("read 5 0x1017 0 u17", "data type 'u17': allowed are b, i8, i16"),
            ("read 5 0x3000 0", "0x3000:00 is not in the dictionary; add its type, for example u16"),
            ("read 5 heartbeat", "no object is called 'heartbeat'"),
            ("read 5 calibration.matrix:10", "with 3 gauges SUB is 1-9"),
            ("read 5 calibration.matrix:10 --gauges 9", "9"),
            ("write 5 heartbeat.producer_ms", "expected NAME VALUE, or INDEX SUB TYPE VALUE"),
            ("write 5 heartbeat.producer_ms 70000", "70000 does not fit UNSIGNED16: allowed are 0 to 65535"),
            ("write 5 heartbeat.producer_ms soon", "'soon' is not UNSIGNED16: write a number as 10 or 0x0A"),
            ("write 5 0x2141 0 xx", "'xx' is not DOMAIN: write hex bytes"),
        )
    ),
    *(
        (f"{NODE} {words}", 2, text)
        for words, text in (
            ("--node-id 0", "--node-id: node-id '0': allowed are 1 to 127"),
            ("--node-id five", "--node-id: node-id 'five': allowed are 1 to 127"),
            ("--source adc", "--source adc: allowed are sim, iio:DEVICE[,DEVICE...], replay:FILE"),
            ("--source iio:device0", "--layout I: the gauges of a real converter need a [bridge] table"),
            ("--layout IV", "layout 'IV': neither one of I, II, III"),
            ("--noise -1", "--noise: '-1': allowed is 0 to 1e+06"),
            ("--scan-rate 0", "--scan-rate: '0': allowed is above 0 up to 100000 Hz"),
            ("--noise nan", "--noise: 'nan': allowed is 0 to 1e+06"),
            ("--noise inf", "--noise: 'inf': allowed is 0 to 1e+06"),
            ("--load 1,2", "--load '1,2': expected 3 numbers separated by commas"),
            ("--load 1,2,x", "--load '1,2,x': expected 3 numbers"),
            ("--load nan,0,0", "--load 'nan,0,0': expected 3 numbers"),
            ("--load 1,inf,0", "--load '1,inf,0': expected 3 numbers"),
            ("--load 1e300,0,0", "allowed is a force up to 1e+09 N"),
            ("--offset 1,2", "--offset '1,2': expected 3 numbers"),
            ("--offset 1,2,nan", "--offset '1,2,nan': expected 3 numbers"),
            ("--offset 1e300,1,1", "allowed is up to 1e+06 microstrain"),
            ("--serial -1", "'-1': allowed are 0 to 0xFFFFFFFF"),
            ("--store .", ": is a directory"),
            ("--store absent/x.json", "absent does not exist"),
        )
    ),
    *(
        (f"vcan {words} -- true", 2, text)
        for words, text in (
            ("--interfaces vcan0,", "'': allowed are a letter"),
            ("--interfaces ../x", "allowed are a letter"),
            ("--interfaces vcan0;reboot", "allowed are a letter"),
            ("--interfaces a234567890123456", "allowed are a letter"),
            ("--interfaces v,v", "distinct names"),
            ("--memory lots", "--memory lots: expected a number with K, M or G"),
            ("--memory 2", "expected a number with K, M or G"),
            ("--timeout 0", "--timeout: '0': allowed are seconds, more than 0"),
            ("--timeout nan", "allowed are seconds, more than 0"),
            ("--host --uml", "not allowed with"),
        )
    ),
    *((words, 2, NO_BUS) for words in ("scan", "sdo read 5 0x1017 0 u16", "dump", "log", "node --node-id 5", "view")),
    ("scan --wait nan -i virtual -c x", 2, "--wait: 'nan': allowed is 0 s or more"),
    ("scan --wait inf -i virtual -c x", 2, "--wait: 'inf': allowed is 0 s or more"),
    ("log vcan0 -n 0", 2, "-n: '0': allowed are whole numbers from 1"),
    ("log vcan0 --seconds -1", 2, "--seconds: '-1': allowed are seconds, more than 0"),
    ("dump vcan0 -T 1.5", 2, "-T: '1.5': allowed are whole numbers from 1"),
    ("replay run.log --speed nan", 2, "--speed: 'nan': allowed are numbers over 0, and inf"),
    ("replay run.log --max-gap soon", 2, "--max-gap: 'soon': allowed are 0 or more seconds"),
    ("replay run.log --loop 0", 2, "--loop: '0': allowed are whole numbers from 1"),
    (
        f"config apply 5 much.toml {NOBODY}",
        2,
        "interrupt_delta:1 (0x6133:01): 'much' is not REAL32: write a number, nan or inf",
    ),
    (f"config apply 5 unknown.toml {NOBODY}", 2, "contact_unknown"),
    (f"config apply 5 minus.toml {NOBODY}", 2, "write $NODEID+0x180"),
    (f"config save 5 {NOBODY}", 2, "which FILE?"),
    (f"config save 5 no/file.toml {NOBODY}", 2, "does not exist; create it first"),
    ("calibrate verify absent.toml --node 5 -i virtual -c x", 2, "calibration absent.toml: No such file or directory"),
    ("export dbc --gauges 9", 2, "9"),
    ("export eds -o absent/x.eds", 2, "absent/x.eds: the directory absent does not exist; create it first"),
    ("lss store -i virtual -c x", 2, "add --serial N"),
    ("lss assign -i virtual -c x", 2, "IDS missing"),
    ("lss assign 1,2 --serial 3 -i virtual -c x", 2, "allowed is one node-id, 2 given"),
    ("lss scan --lss-timeout 0 -i virtual -c x", 2, "allowed is a time over 0 s"),
    ("design sweep SG4", 2, "allowed are a, d, r, h1, h2, width, SG1, SG2, SG3, all"),
    ("design sweep h1 --from 2 --to 1", 2, "a rising range"),
    ("design sweep h1 --from 0", 2, "allowed is a positive finite number"),
    ("design sweep SG1 --to 20", 2, "allowed is 0 to 0.015 m"),
    ("design sweep h1 --steps 1", 2, "2 to 100000 steps"),
    ("design sweep h1 --layout IV", 2, "neither one of"),
    ("design tables", 2, "see `tipforce design --help`"),
    ("design table 4", 2, "see `tipforce design table --help`"),
    ("design sweep", 2, "see `tipforce design sweep --help`"),
    *(
        (f"design optimise --starts 2 {words}", 2, text)
        for words, text in (
            ("--gauges 2", "2 gauges: allowed are 3 to 5"),
            ("--envelope 30", "--envelope '30': expected two numbers"),
            ("--envelope a,b", "--envelope 'a,b': expected two numbers"),
            ("--envelope 30,nan", "limit envelope_y_m = nan"),
            ("--load nan", "load = nan N: allowed"),
            ("--load 0", "load = 0.0 N: allowed"),
            ("--noise nan", "--noise: 'nan': allowed is 0 or more"),
            ("--noise -1", "--noise: '-1': allowed is 0 or more"),
            ("--min-h 0", "limit min_thickness_m = 0.0"),
            ("--max-stress -5", "limit max_stress_pascals = -5000000.0"),
            ("--gauge-length 100", "no design found within the limits"),
            ("-o absent/layout.toml", "absent/layout.toml: the directory absent does not exist; create it first"),
            ("--starts 0", "0 starts: allowed is 1 or more"),
        )
    ),
    ("calibrate budget --noise -1", 2, "--noise: '-1': allowed is 0 to 1e+09"),
    ("calibrate budget --gravity nan", 2, "--gravity: 'nan'"),
    ("calibrate budget --load 0", 2, "--load: '0': allowed is 1e-09 to 1e+09 N"),
    ("calibrate budget --phi 1e9 --theta 0", 2, "--phi: '1e9': allowed are degrees from -360 to 360"),
    ("calibrate budget -o b.txt", 2, "figure b.txt: allowed are the suffixes .svg, .png"),
    ("calibrate budget --layout IV", 2, "layout 'IV'"),
    ("calibrate budget nothing.toml", 2, "calibration nothing.toml"),
    ("calibrate budget nothing.toml --uncalibrated", 2, "--uncalibrated"),
    ("conformance --node-id 5 --case nosuch", 2, "matches no case"),
    ("conformance --node-id 5 --tolerance -1", 2, "--tolerance -1"),
    # damaged logs, and logs of other devices
    *(
        (f"decode prose.txt {words}", 1, "prose.txt: no frames in it; is it a log?")
        for words in ("", "-o out.csv", "--summary", "--json")
    ),
    *((f"{words} prose.txt", 1, NO_LOG) for words in ("monitor", "monitor --json", "replay -i virtual -c no-log")),
    ("dump --decode -q prose.txt", 1, NO_LOG),
    ("decode broken.blf", 1, "the file is damaged or of another format"),
    ("decode noise.asc", 1, "noise.asc"),
    ("decode j1939.log", 1, "all have 29-bit identifiers, which CANopen does not use"),
    ("decode other.log -o x.csv", 1, "`tipforce dump --decode` shows what they are"),
    ("plot j1939.log -o x.svg", 1, "all have 29-bit identifiers"),
    ("monitor j1939.log", 1, "all have 29-bit identifiers"),
    ("view broken.blf", 1, "the file is damaged or of another format"),
    ("dump prose.txt", 1, "other formats: `tipforce decode`"),
    # buses and nodes
    ("scan --nodes 50-60 --wait 0.01 BUS", 5, "is the bus powered and terminated, is the bit rate right?"),
    ("scan --nodes 50 --wait 0 -q BUS", 5, ""),
    ("scan -i socketcan -c nowhere9", 2, "check -i and -c"),
    (f"sdo read 5 0x1017 {NOBODY}", 5, "`tipforce scan` lists nodes"),
    ("lss assign 1 --serial 99 --lss-timeout 0.02 BUS", 5, "serial 99 responded"),
    ("lss scan --lss-timeout 0.02 BUS", 5, "no unconfigured node responded"),
    ("lss store --serial 1005 --product 0x54500103 BUS", 12, "no memory"),
    (f"tare 5 {NOBODY}", 5, "check its power, bus, bit rate and node-id"),
    (f"calibrate apply cal.toml --node 5 --yes {NOBODY}", 5, "`tipforce scan` lists nodes"),
    ("sdo read 5 0x3000 0 u8 BUS", 11, "object does not exist"),
    ("sdo write 5 0x1000 1 BUS", 11, "read-only"),
    ("tare 5 BUS", 11, "the node is not calibrated: `tipforce calibrate apply CAL.toml --node 5` first"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("wrong")
    for name, text in FILES.items():
        (found / name).parent.mkdir(exist_ok=True)
        (found / name).write_text(text)
    (found / "link.csv").symlink_to(found / "readings.csv")
    write_calibration(found / "cal.toml", beam_calibration("I", pull=True))
    write_measurements(found / "data.csv", measured(simulate("I", np.random.default_rng(4))))
    return found


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(("command", "code", "text"), WRONG, ids=[command for command, _, _ in WRONG])
def test_one_line_the_next_step_and_the_exit_code(
    command: str,
    code: int,
    text: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tipforce: Tipforce,
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("can.util.CONFIG_FILES", [])
    monkeypatch.setattr("tipforce_tools.decode.workers.CONNECT_S", 1)
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    before = files(folder)
    channel = new_channel()
    with connected(*([finger(5)] if command.endswith(" BUS") else ()), channel=channel):
        ended = tipforce(command.replace(" BUS", f" -i virtual -c {channel}"))
    assert ended.code == code, ended.err
    assert ended.out == ""
    assert text in ended.err
    assert len(ended.err.splitlines()) <= (2 if code == 1 else 1), ended.err  # of a log also its first bad line
    assert "None" not in ended.err
    assert files(folder) == before
