"""Texts of the help of `edge-sr` and its small commands, in the form that edge.terminal.argument_types lays out."""

from typing import Final

RUN_ABOUT: Final = (
    "Reads a tactile sensor and computes, for each scan (one reading of all taxels, the cells of the sensor), a "
    "pattern: a fine map of how deep an object presses into the pad, in mm."
)

RUN_COMMANDS: Final = """\
commands (each has its own --help):
demo\tan emulated sensor; no hardware needed
devices\tlist what is plugged in, and what to type to read it
doctor\tfind faults of sensor and adapter, and how the pad is mounted
record FILE\trun, and record into a file
replay FILE\tcompute the patterns of a recording
convert FILE NEW\twrite a recording in another format
map\tfuse the patterns into a map of an object larger than the pad
baseline\tmeasure the free pad once, and store it
models\tlist the bundled models
bench\tmeasure error and run time on this machine
"""

RUN_HELP: Final = f"""\
{RUN_COMMANDS}
sources, SRC (found by itself if one adapter is plugged in):
slcan:/dev/ttyUSB0[@BAUD]\tserial CAN adapter, such as VScom or CANable
slcan:serial=D30BL366[@BAUD]\tthe same, by its serial number
gs_usb[:SERIAL]\tUSB CAN adapter with candleLight firmware
gs_usb:BUS-PORT\tthe one at this bus and socket, such as gs_usb:1-2.3
can:socketcan:can0\tadapter that python-can knows
xela-server:ws://HOST[:5000]\tthe vendor's server
replay:FILE[,FILE]\trecording: .mcap, .npz or .csv
demo[:loop]\temulated sensor

outputs, S:
status\tone live line (default on a terminal)
jsonl:FILE\tone JSON record a line; jsonl:- is stdout
mcap:FILE.mcap\trecording, for replay, Foxglove and ROS 2; edge-sr convert makes arrays for numpy of it
shm:NAME\tlatest values in shared memory
zenoh:KEY\tmessages over zenoh; to a router with ?connect=tcp/HOST:7447
ros2:TOPIC\tROS 2 messages

keys on a terminal:
r\tforget earlier taps, as for a new object
z\tzero again: the pad must be free; Z even in contact

lines on stdin, where it is no terminal:
{{"cmd": "reset"}}\tlike key r
{{"cmd": "zero"}}\tlike key z; "sensor": "4" for one sensor, "force": true even in contact
{{"cmd": "pose", "x_mm": 1, "y_mm": 0}}\twhere the pad is

The signal SIGUSR1 is like key z.

examples:
  edge-sr devices
  edge-sr doctor --out sensor.toml
  edge-sr --sensor sensor.toml --view
  edge-sr --sink jsonl:- | your-program

Exit codes: 2 wrong usage, 3 sensor, 4 model, 5 output, 6 ended by force.
"""

DEMO_ABOUT: Final = (
    "Shows what edge-sr does without hardware: an emulated sensor taps a figure four times, and each pattern is "
    "compared with the simulated truth. With --view on a terminal it continues until Ctrl-C."
)

DEMO_HELP: Final = """\
examples:
  edge-sr demo
  edge-sr demo --view
"""

BASELINE_HELP: Final = """\
Keep the pad still, with nothing touching it.

examples:
  edge-sr baseline --out zero.json
  edge-sr --baseline zero.json

Of a recording it takes the scans during which the pad is still and pressed least, or those that you name:
  edge-sr baseline --out zero.json \\
          --source replay:f.csv \\
          --skip 190 --scans 60
"""

RECORD_HELP: Final = """\
examples:
  edge-sr record press.mcap
  edge-sr replay press.mcap --view

All other options are those of edge-sr: its --help lists sources, outputs and keys.
"""

REPLAY_HELP: Final = """\
Computes a result for every scan, as fast as possible, with the times of the recording. It begins \
with the baseline (the readings of the free pad) that was in use at the first scan. If there is none, and the \
recording does not begin free and still, those scans are the baseline during which the pad is still and pressed least.

With --view and no --sink it is played again and again, from the first viewer until Ctrl-C; the page can pause, slow \
and scrub it.

examples:
  edge-sr replay left.csv right.csv \\
          --view
  edge-sr replay press.mcap \\
          --model mtsr4-int8 \\
          --sink mcap:again.mcap
"""

CONVERT_HELP: Final = """\
Formats: .mcap holds all that was recorded, .npz arrays for numpy, .csv counts, times and poses of one sensor (of \
several a file each). What the new file cannot hold is printed. Nothing is computed, and no file is replaced.

examples:
  edge-sr convert press.mcap press.npz
  edge-sr convert press.mcap press.csv
  edge-sr convert old.npz old.mcap
"""

MAP_HELP: Final = """\
Needs poses of the pad (where it is, and how it is turned) in the object's plane: lines on stdin, or those of a \
recording. x points right and y down, as in a pattern.

example:
  my_robot_poses | edge-sr map \\
          --out part.npz --png part.png

A line of poses:
  {"cmd": "pose", "x_mm": 1.5,
   "y_mm": -20, "turn_deg": 5}

All other options are those of edge-sr: its --help lists sources, outputs and keys.
"""
