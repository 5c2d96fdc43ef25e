"""Wrong inputs: one line that names the place and the next step, and the documented exit code."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from host.bus_with_nodes import connected, finger
from tipforce.host.configuration.calibration import write_calibration
from tipforce.scene import beam_calibration
from tipforce.sensor.calibration.simulation import simulate
from tools.blocks import CONTACTS_LOG
from tools.rig import Printed, files, write_readings

SCENES = Path(__file__).parents[2] / "scenes"
EXTENDED = "".join(f"(1700000000.{k:06d}) can0 18FEF1{k:02X}#0102030405060708\n" for k in range(40))
FILES = {
    "run.log": CONTACTS_LOG, "j1939.log": EXTENDED, "other.log": EXTENDED.replace("18FEF1", "3"),
    "prose.txt": "these are no frames\n", "broken.blf": "XXXX" + 200 * "x", "noise.asc": "\x01\x02\x03",
    "bad.toml": "[hand\n", "empty.toml": "", "hand.toml": '[[finger]]\nnode_id = 1\ncalibration = "none.toml"\n',
    "one.toml": "[[finger]]\nnode_id = 1\n", "taken/bus.yml": "routes: 12\n",
    "twice.toml": "[[finger]]\nnode_id = 1\n[[finger]]\nnode_id = 1\n", "scene.toml": "duration_s = -1\n",
    "readings.csv": "SG1,SG2,SG3\n1,2,3\n", "two.csv": "SG1,SG2\n1,2\n",
    "si.csv": "SG1,SG2,SG3,P_N,phi_deg,theta_deg\n", "objects.toml": '[objects]\n"heartbeat.producer_sm" = 1\n',
    "layout.toml": 'points = ["K_H", "S_H"]\n', "empty.dcf": "",
    "zero-hand.toml": '[[finger]]\nnode_id = 5\ncalibration = "zero.toml"\n',
    "zero-scene.toml": 'duration_s = 1\nsync_hz = 9\n[[nodes]]\nids=[5]\npdos = ["contact"]\ncalibration="zero.toml"\n',
    "four.csv": "SG1,SG2,SG3,SG4\n1,2,3,4\n", "five.toml": 'points = ["K_H", "S_H", "U", "T", "L"]',
    "untimed.log": "  vcan0  285   [8]  2E 11 29 23 9A 11 03 03\n",
    "leap.log": "(0000000001.000000) can0 285#E80364006400030A\n(1700000000.000000) can0 285#E80364006400030B\n",
    "node.toml": "duration_s = 1\n[[node]]\n", "nan.csv": "SG1,SG2,SG3,P_N,phi_deg,theta_deg\n1,2,3,nan,0,0\n",
    "inf.toml": "[[finger]]\nnode_id = inf\n", "fast.toml": "[hand]\nsync_hz = 1e12\n[[finger]]\nnode_id = 1\n",
    "names.toml": '[[finger]]\nname = "\u261d"\nnode_id = 1\n[[finger]]\nname = "\u261d"\nnode_id = 2\n',
    "empty.log": "", "static.toml": (SCENES / "static.toml").read_text(), "timed.csv": "t_s,SG1,SG2,SG3\n0,1,2,3\n",
    "words.csv": "t_s,SG1,SG2,SG3\n0,1,2,x\n", "timed4.csv": "t_s,SG1,SG2,SG3,SG4\n0,1,2,3,4\n",
    "gauges.log": "(1.0) can0 185#0A00ECFF1E000201\n",
}  # fmt: skip
_UNIT = "[[1e4, 0, 0], [0, 1e4, 0], [0, 0, 1e4]]"
NO_SENSOR = {  # calibrations that no sensor can have: matrix, variance and covariance of SG1 with SG2, what is said
    "zero": (_UNIT.replace("1e4", "0.0"), 0.25, 0, "rank below 3"),
    "flat": ("[[1e4, 0, 0], [0, 1e4, 0], [1e4, 1e4, 0]]", 0.25, 0, "rank below 3"),
    "nan": (_UNIT.replace("1e4", "nan", 1), 0.25, 0, "nan is not finite"),
    "micro": (_UNIT.replace("1e4", "1e-2"), 0.25, 0, "newtons per microstrain: multiply"),
    "converted": (_UNIT.replace("1e4", "1e10"), 0.25, 0, "converted twice"),
    "grams": (_UNIT.replace("1e4", "1e6"), 0.25, 0, "loads look like grams: multiply the matrix by 0.0098"),
    "quiet": (_UNIT, 0.0, 0, "variance is 0: allowed is above 0"),
    "indefinite": (_UNIT, 0.25, 0.3, "not positive semi-definite"),
}
for _name, (_matrix, _variance, _covariance, _) in NO_SENSOR.items():
    FILES[f"{_name}.toml"] = (
        f"[calibration]\nmatrix_newtons_per_strain = {_matrix}\noffset_microstrain = [0, 0, 0]\nload_sense = 'push'\n"
        f"covariance_microstrain2 = [[{_variance}, {_covariance}, 0], [{_covariance}, 0.25, 0], [0, 0, 0.25]]\n"
    )
MACROS = {
    "X": "-i virtual -c x", "NOBODY": "-i virtual -c nobody --timeout 0.01 --retries 0",
    "NODE": "node --node-id 5 -i virtual -c x", "READ": "sdo read 5", "WRITE": "sdo write 5 heartbeat.producer_ms",
    "FIT": "calibrate fit data.csv --saturation none", "GUIDE": "calibrate guide --node 5 --auto -q --session s.csv",
    "ESTIMATE": "estimate cal.toml readings.csv", "PLOT": "plot run.log -o x.png",
    "OPTIMISE": "design optimise --starts 2",
    "STEEP": "the condition number of C exceeds the limit 2105h:1, or its 2-norm exceeds 1e7 N per unit strain",
    "SHIPPED": ", ".join(sorted(path.stem for path in SCENES.glob("*.toml"))),
    "NO_LOG": "prose.txt: no frames in it; is it a log? line 1: 'these are no frames'",
    "NO_BUS": "no bus given: no CAN interface here; use -i and -c, as in -i slcan -c /dev/ttyACM0",
}  # fmt: skip
# Commands, and a part of the one line that each prints: @ is the last word before the bus, % the word before it.
TABLE = """
exit 2
dumb => '@' is not a command; did you mean dump
scna => did you mean scan?
calibrat => did you mean calibrate?
--compeltion bash => did you mean --completion?
sdo raed 5 P => did you mean read?
simulate cia402 X => names no node-id
simulate cia402 cia402 --node-id 5 X => 1 for 2 files
calibrate appyl x.toml => did you mean apply?
scan --wiat 5 => did you mean --wait
decode --sumary run.log => did you mean --summary?
DEMO! | --json => commands: demo, run, vcan
read 5 --wait 0 X | read 5 --wait nan X => %: '@': allowed is a time over 0 s
export ros2 -o x => --hand:
export ros2 --hand one.toml => --output:
export c --programs -o x => the exported C has no program slots
config save 5 x.xdc NOBODY => allowed are TOML, and a DCF by the suffix
export dcf --node-id 5 --eds one.toml | export eds --eds one.toml => --eds is for xdd alone
export dbc --node-id 5 => --node-id is for dcf, xdd alone; a DBC has --nodes
export eds --node-id 5 => --node-id is for dcf, xdd alone; leave it out
export eds --nodes 5 => --nodes is for dbc alone; leave it out
export c --simulated -o x | export dbc --simulated => --simulated is for eds, dcf, xdd alone
export xdd --settings one.toml | export eds --settings one.toml => --settings is for dcf alone
decode --from yesterday run.log | decode --from 0001-01-01 run.log => allowed are seconds from the start
decode --gauges 9 run.log => --gauges
decode --signals Q run.log => no message has the signal Q: allowed are
decode --jobs 0 run.log => --jobs: '0': allowed are whole numbers from 1
decode --resample 1e-320 run.log | decode --resample 0 run.log => --resample
decode --resample 1e9 run.log => choose a lower rate
decode --dcf empty.dcf run.log => no [section] in it
decode run.log -o out.xyz => unknown suffix: allowed are
decode run.log --format parquet => needs --output FILE
decode run.log -o \udcff.parquet | decode run.log -o \udcff/ => its path is not UTF-8
decode none.log | dump none.log | view none.log | monitor none.log => @: no such file
decode none/*.log => no file matches
decode . => is a directory; name its logs
dump . => @: is a directory
dump run.log --sync 100 | monitor run.log --sync 100 | view run.log --sync 100 => is no bus to listen to
decode - run.log => stdin cannot be decoded together with files
decode --calibration none.toml run.log | hand check hand.toml => none.toml: No such file
decode --dbc none.dbc run.log => none.dbc
dump any,18G:7FF run.log => filter '18G:7FF'
dump -L -e run.log => leave one out
plot run.log => add -o FILE.png
plot run.log -o x.doc | plot run.log -o run.log => allowed are the suffixes .svg, .png
design sweep r --steps 5 -o r.gif | calibrate budget -o b.txt => allowed are the suffixes .svg, .png
plot run.log -o none/x.svg | log -o none/x.log X | GUIDE -o none/a.toml BUS => does not exist; create it first
ESTIMATE -o none/out.csv | run static -o none/x.log | GUIDE --session none/a.csv BUS => does not exist; create it first
NODE --store absent/x.json | config save 5 no/file.toml NOBODY => does not exist; create it first
export eds -o absent/x.eds | OPTIMISE -o absent/layout.toml => does not exist; create it first
replay none.log X | hand run none.toml | hand run bad.toml | run none.toml | run empty.toml => @
calibrate fit prose.txt | calibrate fit si.csv | replay run.log vcan0 X | ros2 none.log => @
READ heartbeat.producer NOBODY | config apply 5 objects.toml NOBODY => close to it: heartbeat.producer_ms
READ 0x1018 NOBODY => has several sub-indices
READ 0x1018:09 NOBODY => no sub-index 9
nmt begin 5 X => invalid choice: 'begin'
tare 5 --clear --show X | vcan --host --uml -- true => not allowed with argument
scan -i nonsense => invalid choice: '@'
scan --wait -1 X | scan --wait nan X | scan --wait inf X => %: '@': allowed is 0 s or more
scan --timeout 0 X | scan --timeout -1 X | scan --timeout nan X | scan --timeout inf X | scan --retries -1 X => allowed
read 5 -n x X => '@': allowed are whole numbers from 1
config show 5 x.toml X => takes no FILE
hand check twice.toml => node_id
hand run hand.toml --seconds 0 | vcan --timeout 0 -- true => %: '@': allowed are seconds, more than 0
log vcan0 --seconds -1 | ros2 --seconds 0 | vcan --timeout nan -- true => %: '@': allowed are seconds, more than 0
run scene.toml => duration_s
calibrate fit none.csv | estimate cal.toml none.csv | replay none.blf X => @: No such file
firmware install 5 none.bin X => @: No such file
calibrate verify hand.toml --node 5 X | estimate hand.toml readings.csv => hand.toml
estimate cal.toml two.csv => allowed are SG1 to SGn without a gap, n = 3 to 8
ESTIMATE -o readings.csv | decode run.log -o run.log --format csv | ESTIMATE -o ./link.csv => is also an input
ESTIMATE -o cal.toml | FIT -o data.csv => is also an input
calibrate budget cal.toml --phi 10 => one load needs both
design sweep h2 --layout layout.toml => layout
export eds --gauges 2 | export eds --gauges 99999999999999999999 => allowed 3 to 8
report -o run.log | export c -o run.log => is a file; name a directory
view run.log --from 100 => no sample between --from and --to; the log lasts 0.049 s
view run.log --from nan => %: '@': allowed is 0 to 1e+09 s
doctor --listen -1 => '@': allowed are 0 to 3600 s
design optimise --seed -1 | demo --seed 1e9 => %: '@': allowed are whole numbers from 0
calibrate budget --load 1e300 | calibrate budget --load 0 => %: '@': allowed is 1e-09 to 1e+09 N
calibrate budget --noise 1e300 | calibrate budget --noise -1 => %: '@': allowed is 0 to 1e+09
export ros2 --hand one.toml -o taken => the existing file is not a bus.yml of ros2_canopen
dump ,181:7FF - => no channel
dump - - => only one
dump -L -a - => -L and -a
dump -ta untimed.log | replay untimed.log X | plot untimed.log -o x.png => no timestamps
decode --from 1 untimed.log -o x.csv | decode untimed.log -o x.mcap => no timestamps
decode run.log -o taken => taken/: is not empty and not a dataset
decode run.log -o data/ --resample 10 | decode run.log -o data/ --calibration cal.toml => leave out --calibration
decode run.log -o a.csv --hand left => --hand: is a partition of a dataset
log -o run.log X => @ exists
log -o run.xyz X | log -o run.blf.gz X | log -o run X => allowed are .asc,
log run.log X => allowed are buses
replay - --loop 2 X => stdin can be read only once
replay run.log a=b X => allowed is one of them
replay run.log --speed 0 | replay run.log --speed nan => %: '@': allowed are numbers over 0, and inf
replay run.log --max-gap -1 | replay run.log --max-gap soon => %: '@': allowed are 0 or more seconds
monitor --speed 1 X => --follow and --speed: need a log
monitor can0,181:7FF can0 | monitor any can0 => allowed is each bus once
monitor run.log can0 => --nodes selects from a log
monitor x.log --once 0 | monitor x.log --once x | monitor x.log --interval nan | monitor x.log --speed 0 => allowed
PLOT --signals Q => no message has the signal Q
PLOT --nodes 77 => with --nodes), so there is nothing to draw
PLOT --size 10 | PLOT --size 0x5 | PLOT --size 10x10furlong => allowed are 16x10cm, 160x100mm or 7x4in
PLOT --size 1000x1000 | PLOT --size x => allowed are 16x10cm, 160x100mm or 7x4in
decode --resample 1000 leap.log -o x.csv => intervals without a sample
decode --calibration 999=a.toml run.log => 999
decode --dcf none.dcf run.log => none.dcf
decode --scheduler tcp://127.0.0.1:1 run.log => --scheduler
decode run.log -o readings.csv --format jsonl => readings.csv: the existing file is not a JSON lines file
estimate cal.toml four.csv => 4 gauges, the calibration
ESTIMATE --saturation -5 | FIT --noise 0 | FIT --saturation nan | GUIDE --period 0 BUS => %: '@': allowed is above 0
GUIDE --max-std nan BUS | GUIDE --max-drift -1 BUS | GUIDE --saturation -3 BUS => %: '@': allowed is above 0
FIT --prior beam | GUIDE --prior beam BUS => --prior @ needs --layout
FIT --angle-scatter -1 | GUIDE --angle-scatter 30 BUS => %: '@': allowed is 0 to 20 degrees
FIT --serial -1 | NODE --serial -1 => '@': allowed are 0 to 0xFFFFFFFF
FIT --layout IV | GUIDE --layout IV BUS | calibrate budget --layout IV => layout '@': neither one of I, II, III
NODE --layout IV | design sweep h1 --layout IV => layout '@': neither one of I, II, III
FIT --layout five.toml => has 5 gauges
NODE --layout . => Is a directory
FIT --no-offset --drift tare => needs an offset to drift
FIT -o static.toml => @: the existing file is not a calibration file
GUIDE --samples 5 BUS => --samples: '5': allowed is 10 to 100000
GUIDE --plan a.toml --weights 1 BUS => --plan and --weights: allowed is one of them
GUIDE --layout five.toml BUS => @ has 5 gauges, the node has 3
ros2 --speed 0 run.log => --speed: '0': allowed are numbers over 0, and inf
ros2 --no-bring-up => @: needs a hand file
ros2 --allow-tare run.log => --allow-tare: needs a hand file that is commissioned
ros2 --gauges 9 => --gauges: invalid choice: 9
ros2 --namespace left-hand => % '@': allowed are letters, digits and _
ros2 --domain 233 => % @: allowed are 0 to 232
calibrate budget zero.toml | hand check zero-hand.toml | run zero-scene.toml => rank below 3
decode run.log --calibration zero.toml | calibrate apply zero.toml --node 5 --yes X => rank below 3
run node.toml | run node.toml --explain => node: no such key; did you mean nodes?
run static.toml -o static.toml => @: the existing file is not a candump log
export eds -o cal.toml => @: the existing file is not an EDS or DCF
export eds -o . => is a directory; name a file
export c => --output: `export c` writes several files; name a folder
export c -o cal.toml => --output @: is a file; name a directory
export c --gauges 2 -o x => number of gauges: 2
export dcf => --node-id: a DCF belongs to one node; add it, for example --node-id 5
export dcf --node-id 5 --settings absent.toml => @: No such file
design optimise -o cal.toml => @: the existing file is not a layout file
demo --view --host 192.0.2.1 | view run.log --host 192.0.2.1 | demo --view --host 0.0.0.0 --token auto => --host
view run.log --host 0.0.0.0 --token auto | view run.log --host hand.local => --host
demo --view --port 70000 | view run.log --port 70000 => %: '@': allowed are 0
demo --view --token short | view run.log --token short => --token
view none.toml -i virtual --port 0 | view - -i virtual --port 0 | view run.log --no-bring-up -i virtual --port 0 =>
sdo read 0 0x1000 0 NOBODY | NODE --node-id 0 => node-id '@': allowed are 1 to 127
NODE --node-id five | monitor run.log --nodes 300 | tare all X => node-id '@': allowed are 1 to 127
READ NOBODY => object missing
sdo dump 5 0x1017 0 NOBODY => tipforce: sdo dump: reads all objects; for one: tipforce sdo read 5 0x1017 0
nmt start all --wait X => needs node-ids
READ 0x1017 0 u16 5 NOBODY => '0x1017 0 u16 5': too many words; expected NAME, or INDEX SUB [TYPE]
READ x 0 u16 NOBODY => 'x' '0' is not INDEX SUB; write 0x1017 0, or one NAME
READ 0x1017 y NOBODY => '0x1017' '@' is not INDEX SUB
READ 0x10000 0 u8 NOBODY => index 0x10000 sub 0: allowed are 0 to 0xFFFF and 0 to 0xFF
READ 0x1000 256 u8 NOBODY => sub 256: allowed are
READ -1 0 u8 NOBODY => index -1 sub 0: allowed are
READ 0x1017 0 u17 NOBODY => data type '@': allowed are b, i8, i16
READ 0x3000 0 NOBODY => 0x3000:00 is not in the dictionary; add its type, for example u16
READ heartbeat NOBODY | READ ☃ NOBODY => no object is called '@'
READ calibration.matrix:10 NOBODY => with 3 gauges SUB is 1-9
READ calibration.matrix:10 --gauges 9 NOBODY | export dbc --gauges 9 => 9
WRITE NOBODY => expected NAME VALUE, or INDEX SUB TYPE VALUE
WRITE 70000 NOBODY | WRITE -1 NOBODY => @ does not fit UNSIGNED16: allowed are 0 to 65535
WRITE soon NOBODY => '@' is not UNSIGNED16: write a number as 10 or 0x0A
sdo write 5 0x2141 0 xx NOBODY => '@' is not DOMAIN: write hex bytes
NODE --source adc => % @: allowed are sim, iio:DEVICE[,DEVICE...], replay:FILE
NODE --source iio:device0 => --layout I: the gauges of a real converter need a [bridge] table
NODE --source replay:readings.csv => column t_s is missing
NODE --source replay:words.csv => line 2
NODE --source replay:timed4.csv => 4 gauges; the layout has 3
NODE --source replay:timed.csv --speed 0 => speed 0.0
NODE --source replay:prose.txt => no gauge PDO, and no CSV header with SG1
NODE --source replay:gauges.log@9 => no gauge PDO of node 9
NODE --source replay:gauges.log@0 => '0' after
NODE --source replay:none => No such file
NODE --noise -1 | NODE --noise nan | NODE --noise inf => %: '@': allowed is 0 to 1e+06
NODE --scan-rate 0 => %: '@': allowed is above 0 up to 100000 Hz
NODE --load 1,2 | NODE --load 1,2,x | NODE --load nan,0,0 | NODE --load 1,inf,0 => % '@': expected 3 numbers
NODE --offset 1,2 | NODE --offset 1,2,nan => % '@': expected 3 numbers
NODE --load 1e300,0,0 => allowed is a force up to 1e+09 N
NODE --offset 1e300,1,1 => allowed is up to 1e+06 microstrain
NODE --store . => : is a directory
NODE --priority 100 => allowed are 1 to 99
vcan --interfaces vcan0, -- true => '': allowed are a letter
vcan --interfaces ../x -- true | vcan --interfaces vcan0;reboot -- true => allowed are a letter
vcan --interfaces a234567890123456 -- true => allowed are a letter
vcan --interfaces v,v -- true => distinct names
vcan --memory lots -- true | vcan --memory 2 -- true => % @: expected a number with K, M or G
scan | READ 0x1017 0 u16 | dump | log | node --node-id 5 | view => NO_BUS
log vcan0 -n 0 | dump vcan0 -T 1.5 | replay run.log --loop 0 => %: '@': allowed are whole numbers from 1
config apply 5 none.toml NOBODY | config apply 5 none.dcf NOBODY => @: No such file or directory
config apply 5 empty.dcf NOBODY => @: no [section] in it
config save 5 NOBODY => which FILE?
simulate x.eds --set foo X | simulate x.eds --set =4 X | simulate x.eds --set 5:=4 X => '@': the form is OBJECT=VALUE
simulate x.eds --node-id 5 --set 7:0x1017=4 X => no node 7 here
simulate x.eds --node-id 5,6 --set 0x1017=4 X => several nodes; write ID:OBJECT=VALUE
simulate a b c --node-id 5,6 X => 2 for 3 files
simulate x.eds --node-id 5,6 --store s.json X => one file belongs to one node
simulate node.toml --node-id 5 X => a machine in TOML stands alone
decode run.log --dbc tipforce --dcf empty.dcf => leave out --dcf and --ask
decode run.log --signals , => expected names such as P,theta
export xdd --programs --eds empty.dcf | export xdd --simulated --eds empty.dcf => leave one out
calibrate verify absent.toml --node 5 X => calibration absent.toml: No such file or directory
lss store X => add --serial N
lss assign X => IDS missing
lss assign 1,2 --serial 3 X => allowed is one node-id, 2 given
lss scan --lss-timeout 0 X => allowed is a time over 0 s
design sweep SG4 => allowed are a, d, r, h1, h2, width, SG1, SG2, SG3, all
design sweep h1 --from 2 --to 1 => a rising range
design sweep h1 --from 0 => allowed is a positive finite number
design sweep SG1 --to 20 => allowed is 0 to 0.015 m
design sweep h1 --steps 1 => 2 to 100000 steps
design tables => see `tipforce design --help`
design table 4 => see `tipforce design table --help`
design sweep => see `tipforce design @ --help`
OPTIMISE --gauges 2 => 2 gauges: allowed are 3 to 5
OPTIMISE --envelope 30 | OPTIMISE --envelope a,b => % '@': expected two numbers
OPTIMISE --envelope 30,nan => limit envelope_y_m = nan
OPTIMISE --load nan => load = @ N: allowed
monitor --sync 1e-320 X | dump --sync 1e-320 X => --sync: '1e-320': allowed is 1e-6 to 10000 Hz
OPTIMISE --load 0 | OPTIMISE --load 1e300 => N: allowed is 1e-9 to 1e9
OPTIMISE --noise nan | OPTIMISE --noise 0 => %: '@': allowed is above 0
calibrate budget --gravity nan => %: '@'
calibrate budget --phi 1e9 --theta 0 => --phi: '1e9': allowed are degrees from -360 to 360
conformance --node-id 5 --case nosuch => matches no case
conformance --node-id 5 --tolerance -1 | conformance --node-id 5 --tolerance 99999999999999999999 => % @: allowed are
scan -i socketcan -c nowhere9 => check -i and -c
monitor folder.toml => @: is a directory; name a log in it
read X => required: IDS
scan --nodes 5, X => '@': write 1,2,5-9
scan X -b -5 | monitor X -b 0 | monitor run.log -b 0 => --bitrate @: allowed is a rate over 0 bit/s
scan X -b lots => invalid int value: '@'
scan -i slcan -c /dev/ttyNONE => channel @:
config apply 5 binary.toml NOBODY | hand check binary.toml | doctor binary.toml => @: the file is not UTF-8
config apply 5 folder.toml NOBODY | calibrate fit folder.toml | simulate folder.toml X => @: Is a directory
calibrate fit binary.toml => @: line 1: byte 0xFA is not UTF-8
calibrate fit nan.csv => @: no row can be used; the first: line 2: P_N is 'nan'
calibrate guide --node 5 --weights -4.4 X | GUIDE --weights heavy BUS => % '@': allowed are newtons above 0
GUIDE --grooves x30,z20 BUS => 'z20': allowed are paper, or grooves: x30,y60
GUIDE --grooves y190 BUS => theta 0 to 180
GUIDE --grooves x30,x45 BUS => cannot show
GUIDE --plan none.toml BUS => @: No such file
GUIDE --session two.csv BUS | GUIDE --session prose.txt BUS | GUIDE --session binary.toml BUS => session @
calibrate budget -o no/b.png => does not exist; create it first
calibrate budget nothing.toml | calibrate budget folder.toml | calibrate budget binary.toml => calibration @
run grsp | run --explain grsp | view grsp => grsp: no such file; by name ship SHIPPED
estimate empty.toml readings.csv => empty.toml: calibration is missing
hand check inf.toml => node_id is inf: allowed are finite numbers
hand check fast.toml => sync_hz = 1e+12: allowed are 0 (another sends it) to 10000
hand check names.toml => name = '☝' is a duplicate
plot -o x.png none.log | view grasp.toml => @: no such file
view run.log --nodes 99 => run.log: no PDO of the chosen nodes
decode run.log --from 5 --to 1 => --from 5 --to 1: allowed is an end after the start
decode run.log --eds empty.dcf => the form is ID=FILE
dataset show none => @: is not a dataset
run grasp --duration nan => % @: allowed are more than 0
conformance X => one of the arguments --node-id --list is required
--completion powershell | --completion => allowed are bash, zsh, fish
exit 1
monitor empty.log | dump empty.log | decode empty.log | plot empty.log -o x.png => empty.log: no frames in it
view empty.log => empty.log: no frames in it
replay empty.log X => empty.log: no frames in it; is it a log? known formats: candump text
decode prose.txt | decode prose.txt -o out.csv | decode prose.txt --summary => prose.txt: no frames in it; is it a log?
decode prose.txt --json => prose.txt: no frames in it; is it a log?
monitor prose.txt | monitor --json prose.txt | replay -i virtual -c no-log prose.txt => NO_LOG
dump --decode -q prose.txt => NO_LOG
decode broken.blf | view broken.blf | replay broken.blf X => the file is damaged or of another format
decode noise.asc => @
decode j1939.log | plot j1939.log -o x.svg => all have 29-bit identifiers, which CANopen does not use
monitor j1939.log => all have 29-bit identifiers, which CANopen does not use
decode other.log -o x.csv | view other.log => `tipforce dump --decode` shows what they are
dump prose.txt => pcap and pcapng
dump binary.toml => binary.toml: no frames in it; is it a log?
exit 5
scan --nodes 50-60 --wait 0.01 BUS => is the bus powered and terminated, is the bit rate right?
scan --nodes 50 --wait 0 -q BUS =>
READ 0x1017 NOBODY | calibrate apply cal.toml --node 5 --yes NOBODY | GUIDE NOBODY => `tipforce scan` lists nodes
read 5 --wait 0.2 NOBODY => node 5
lss assign 1 --serial 99 --lss-timeout 0.02 BUS => serial 99 responded
lss scan --lss-timeout 0.02 BUS => no unconfigured node responded
lss assign 4 --lss-timeout 0.02 BUS => Configured nodes take no part
tare 5 NOBODY => check its power, bus, bit rate and node-id
exit 11
READ 0x3000 0 u8 BUS => object does not exist
sdo write 5 0x1000 1 BUS => read-only
tare 5 BUS => the node is not calibrated: `tipforce calibrate apply CAL.toml --node 5` first
exit 12
calibrate apply steep.toml --node 5 --no-store -q BUS => node 5 rejected the calibration (0x06090031): STEEP
lss store --serial 1005 --product 0x54500103 BUS => no memory
"""


def cases() -> Iterator[tuple[str, int, str]]:
    """Each command, its exit code, and the part of its line."""
    code = 2
    for line in TABLE.strip().splitlines():
        commands, _, text = line.partition(" =>")
        if commands.startswith("exit "):
            code = int(commands[5:])
            continue
        for command in commands.split(" | "):
            words = [word for word in command.removesuffix(" -- true").split() if word not in ("X", "BUS", "NOBODY")]
            part = " ".join(MACROS.get(word, word) for word in text.strip().split(" "))
            whole = " ".join(MACROS.get(word, word) for word in command.split(" "))
            yield whole, code, part.replace("@", words[-1]).replace("%", words[-2] if "%" in part else "")
    for name, (*_, text) in NO_SENSOR.items():
        yield f"estimate {name}.toml readings.csv", 2, text


WRONG = list(cases())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("wrong")
    for name, text in FILES.items():
        (found / name).parent.mkdir(exist_ok=True)
        (found / name).write_text(text)
    (found / "binary.toml").write_bytes(bytes(range(250, 0, -1)))
    (found / "folder.toml").mkdir()
    (found / "link.csv").symlink_to(found / "readings.csv")
    cal = beam_calibration("I", pull=True)
    write_calibration(found / "cal.toml", cal)
    write_calibration(found / "steep.toml", replace(cal, C=cal.C * [1.0, 1.0, 1e-5]))
    write_readings(found / "data.csv", simulate("I", np.random.default_rng(4)))
    return found


@pytest.mark.parametrize(("command", "code", "text"), WRONG, ids=[command for command, _, _ in WRONG])
def test_one_line_the_next_step_and_the_exit_code(
    command: str, code: int, text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed, channel: str
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder / "taken"))
    monkeypatch.setattr("tipforce_tools.decode.workers.CONNECT_S", 1)
    before = files(folder)
    with connected(*([finger(5)] if command.endswith(" BUS") else ()), channel=channel):
        out, err = printed(code, command.replace(" BUS", f" -i virtual -c {channel}"))
    assert out == ""
    assert text in err
    assert len(err.splitlines()) <= (2 if code == 1 else 1), err  # of a log also its first bad line
    assert "None" not in err
    assert files(folder) == before
