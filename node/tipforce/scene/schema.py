"""The content of a scene file: one struct per table, with units in the names. docs/scenes.md documents it for users."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from tipforce.errors import InputError
from tipforce.sources.simulated import force_of

Positive = Annotated[float, Meta(gt=0.0, le=1e9)]
NotNegative = Annotated[float, Meta(ge=0.0, le=1e9)]
NodeId = Annotated[int, Meta(ge=1, le=127)]
Microstrain = Annotated[float, Meta(gt=0.0, le=1e6)]
Angle = Annotated[float, Meta(ge=-360.0, le=360.0)]
Pdo = Literal["gauges", "contact", "force", "health"]
FaultKind = Literal["stuck", "open", "saturate", "silent", "drift"]
NodeIds = tuple[NodeId, ...]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class Nodes(_Table, frozen=True, kw_only=True):
    """[[nodes]]: identical fingertips."""

    ids: NodeIds
    names: tuple[str, ...] = ()
    """Of the fingers, in the order of ``ids``; for `tipforce view`."""
    pdos: tuple[Pdo, ...]
    """PDOs that are sent; the others are disabled by bit 31 of their COB-ID."""
    layout: Literal["I", "II", "III", "I'", "II'", "III'"] | tuple[str, ...] = "I"
    """A case of Table 3, its mirror, or 3 to 8 points of Table 1."""
    calibration: str = "model"
    """"model": the inverse of the structure's strain matrix; "none"; or a calibration file (TOML)."""
    sense: Literal["push", "pull"] = "push"
    """Direction of the load at the surface; 2110h:6 of a "model" calibration."""
    status: bool = True
    """False leaves the status byte 2120h out of every mapping."""
    sample_period_us: Annotated[int, Meta(ge=100, le=1_000_000)] = 500
    filter: Literal["moving_average", "repeating_average", "first_order"] | None = None
    """61A0h of every gauge; without it none."""
    filter_constant: Annotated[int, Meta(ge=1, le=65535)] = 1
    """61A1h: readings in the average; for the first-order filter its time constant in sample periods."""
    heartbeat_ms: Annotated[int, Meta(ge=0, le=65535)] = 0
    offset_microstrain: tuple[float, ...] = ()
    """Reading of each gauge without load; a "model" calibration includes it."""


Triple = tuple[float, float, float]  # P newtons, phi and theta degrees
Knot = tuple[float, float, float, float]  # t seconds, P, phi, theta


class LoadHistory:
    """P, phi and theta of one finger, linear between its knots, constant before the first and after the last. Two knots
    at one time make a step: the later one applies from that time on."""

    __slots__ = ("_times", "knots")

    def __init__(self, knots: Sequence[Knot]) -> None:
        self.knots = tuple(knots)
        self._times = [knot[0] for knot in self.knots]

    @property
    def constant(self) -> bool:
        """True if the load is constant over time."""
        return all(knot[1:] == self.knots[0][1:] for knot in self.knots)

    def at(self, t_s: float) -> Triple:
        """Return (P newtons, phi degree, theta degree) at a time."""
        after = bisect.bisect_right(self._times, t_s)
        if after == 0 or after == len(self.knots):
            _, P, phi, theta = self.knots[max(after - 1, 0)]
            return P, phi, theta
        before, behind = self.knots[after - 1], self.knots[after]
        part = (t_s - before[0]) / (behind[0] - before[0])
        P, phi, theta = (a + part * (b - a) for a, b in zip(before[1:], behind[1:], strict=True))
        return P, phi, theta

    def force(self, t_s: float) -> Triple:
        """Return (F1, F2, F3) in newtons, equation (16)."""
        return force_of(self.at(t_s))


class _Load(_Table, frozen=True, kw_only=True, tag_field="kind"):
    nodes: NodeIds = ()
    """Loaded nodes; without it all of them."""

    def history(self, node_id: int) -> LoadHistory | None:
        """Return the load of a node, None for a finger that a grasp does not use. Raises InputError."""
        knots = self._knots(node_id)
        return LoadHistory(knots) if knots else None

    def _knots(self, node_id: int) -> list[Knot]:
        raise NotImplementedError


def _along(direction: Static | Ramp | Tap | Finger, magnitudes: Iterable[tuple[float, float]]) -> list[Knot]:
    return [(t, P, direction.phi_deg, direction.theta_deg) for t, P in magnitudes]


class Static(_Load, frozen=True, kw_only=True, tag="static"):
    """The same load from beginning to end."""

    P_N: NotNegative
    phi_deg: Angle
    theta_deg: Angle

    def _knots(self, _node_id: int) -> list[Knot]:
        return _along(self, [(0.0, self.P_N)])


class History(_Load, frozen=True, kw_only=True, tag="history"):
    """Values at times, linear in between, constant before and after. Equal times make a step."""

    t_s: tuple[float, ...]
    P_N: tuple[NotNegative, ...] | NotNegative
    phi_deg: tuple[float, ...] | Angle
    theta_deg: tuple[float, ...] | Angle

    def _knots(self, _node_id: int) -> list[Knot]:
        count = len(self.t_s)
        given = {"P_N": self.P_N, "phi_deg": self.phi_deg, "theta_deg": self.theta_deg}
        columns = {name: value if isinstance(value, tuple) else (value,) * count for name, value in given.items()}
        for name, column in columns.items():
            if len(column) != count or not count:
                raise InputError(f"{name} has {len(column)} values: allowed are {count} (as t_s) or one number")
        if any(later < earlier for earlier, later in pairwise(self.t_s)):
            raise InputError(f"t_s = {list(self.t_s)}: allowed are non-decreasing times")
        return list(zip(self.t_s, *columns.values(), strict=True))


class Grooves(_Load, frozen=True, kw_only=True, tag="grooves"):
    """The paper's rig (section 4.1): a rope with a weight in 19 grooves, one after the other, with tares in between."""

    P_N: Positive = 4.4
    dwell_s: Positive = 0.1
    change_s: Positive = 0.05
    """Total time for unloading, moving the rope and loading."""

    def _knots(self, _node_id: int) -> list[Knot]:
        from tipforce.sensor.structure.layouts import GROOVES_DEG

        knots: list[Knot] = []
        t, third = 0.0, self.change_s / 3.0
        for phi, theta in GROOVES_DEG:
            # Unloaded for the middle third of a change: a tare reading between two grooves.
            knots += [(t, 0.0, phi, theta), (t + third, self.P_N, phi, theta)]
            t += third + self.dwell_s
            knots += [(t, self.P_N, phi, theta), (t + third, 0.0, phi, theta)]
            t += 2.0 * third
        return knots


class Ramp(_Load, frozen=True, kw_only=True, tag="ramp"):
    """P from one value to another; constant before and after."""

    to_N: NotNegative
    end_s: Positive
    phi_deg: Angle
    theta_deg: Angle
    from_N: NotNegative = 0.0
    start_s: NotNegative = 0.0

    def _knots(self, _node_id: int) -> list[Knot]:
        return _along(self, [(self.start_s, self.from_N), (self.end_s, self.to_N)])


class Tap(_Load, frozen=True, kw_only=True, tag="tap"):
    """Short pushes: up to P in rise_ms, back to zero in fall_ms, from each of the times at_s."""

    P_N: Positive
    at_s: tuple[NotNegative, ...]
    phi_deg: Angle
    theta_deg: Angle
    rise_ms: Positive = 1.0
    fall_ms: Positive = 1.0

    def _knots(self, _node_id: int) -> list[Knot]:
        rise_s, fall_s = 1e-3 * self.rise_ms, 1e-3 * self.fall_ms
        magnitudes: list[tuple[float, float]] = []
        for t in sorted(self.at_s):
            magnitudes += [(t, 0.0), (t + rise_s, self.P_N), (t + rise_s + fall_s, 0.0)]
        return _along(self, magnitudes)


class Finger(_Table, frozen=True, kw_only=True):
    """Load on one finger of a grasp."""

    node: NodeId
    P_N: NotNegative
    phi_deg: Angle
    theta_deg: Angle
    delay_s: NotNegative = 0.0


class Grasp(_Load, frozen=True, kw_only=True, tag="grasp"):
    """Fingers close on an object, hold it, and open: each with its own load."""

    fingers: tuple[Finger, ...]
    start_s: NotNegative = 0.0
    close_s: Positive = 0.2
    hold_s: NotNegative = 1.0
    open_s: Positive = 0.2

    def _knots(self, node_id: int) -> list[Knot]:
        for finger in self.fingers:
            if finger.node == node_id:
                begin = self.start_s + finger.delay_s
                closed = begin + self.close_s
                opening = closed + self.hold_s
                magnitudes = [(closed, finger.P_N), (opening, finger.P_N), (opening + self.open_s, 0.0)]
                return _along(finger, [(begin, 0.0), *magnitudes])
        return []


Load = Static | History | Grooves | Ramp | Tap | Grasp


class Noise(_Table, frozen=True, kw_only=True):
    """[noise]: of each gauge, from the scene's seed."""

    gauge_microstrain: Microstrain | None = None
    """Standard deviation of white noise."""
    one_over_f_microstrain: Microstrain | None = None
    """Density at 1 Hz of 1/f noise, microstrain per square root of hertz."""


class FrontEnd(_Table, frozen=True, kw_only=True):
    """[front_end]: bridge, amplifier, temperature, converter. Without it an ideal converter of 16 bits."""

    bits: Literal[16, 24] = 16
    bridge: Literal["quarter", "half", "full"] | None = None
    gauge_factor: Positive = 2.0
    excitation_volts: Positive = 3.3
    gain: Positive | None = None
    """Without it the full scale is 3276.8 microstrain."""
    reference_volts: Positive | None = None
    temperature_degC: float | tuple[tuple[float, float], ...] | None = None
    """Of the tip: one number, or points [seconds, degC] joined by lines."""
    apparent_microstrain_per_degC: float | tuple[float, ...] | None = None
    gain_drift_ppm_per_degC: float | None = None


class Dynamics(_Table, frozen=True, kw_only=True):
    """[dynamics]: the tip vibrates on its beams; the gauges measure the elastic force, not the load."""

    damping_ratio: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.01
    step_us: Annotated[int, Meta(ge=1, le=1_000_000)] = 100
    """The load is linear during a step; for such a load the motion is exact."""


class Slit(_Table, frozen=True, kw_only=True):
    """[slit]: report loads that close the slit between tip and beam, where real gauges leave the linear model."""

    gap_mm: Positive = 0.25


class Fault(_Table, frozen=True, kw_only=True):
    """[[faults]]: faults injected through object 2200h, from at_s until until_s."""

    kind: FaultKind
    nodes: NodeIds
    at_s: NotNegative
    until_s: Positive | None = None
    gauge: Annotated[int, Meta(ge=1, le=8)] = 1
    microstrain_per_s: float = 0.0


class Outputs(_Table, frozen=True, kw_only=True):
    """[outputs]: files to write; below the working directory."""

    log: str | None = None
    table: str | None = None
    plot: str | None = None


class Bus(_Table, frozen=True, kw_only=True):
    """[bus]: a python-can bus in real time. Without it time is simulated and there is no bus."""

    interface: str | None = None
    """Without it python-can's configuration files and environment decide."""
    channel: str | None = None
    bitrate: Annotated[int, Meta(gt=0)] | None = None


class Expect(_Table, frozen=True, kw_only=True):
    """[[expect]]: conditions; `tipforce run` exits with 1 if one fails. Errors are estimate minus applied, if known."""

    nodes: NodeIds = ()
    from_s: NotNegative = 0.0
    to_s: Positive | None = None
    P_error_N: Positive | None = None
    phi_error_deg: Positive | None = None
    theta_error_deg: Positive | None = None
    """Largest absolute error."""
    P_rms_N: Positive | None = None
    phi_rms_deg: Positive | None = None
    theta_rms_deg: Positive | None = None
    P_known_at_least: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    P_known_at_most: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    """Share of the SYNCs with a known P."""
    status_seen: tuple[str, ...] = ()
    status_never: tuple[str, ...] = ()
    """Names of bits of 2120h."""
    slit_closes: bool | None = None
    """Whether an applied load closes the slit; needs [slit]."""
    emcy_seen: tuple[str, ...] = ()
    """Error codes as "5010"."""
    emcy_none: bool = False


class Scene(_Table, frozen=True, kw_only=True):
    """A whole scene file."""

    duration_s: Annotated[float, Meta(gt=0.0, le=86_400.0)]
    nodes: tuple[Nodes, ...]
    start: Annotated[datetime, Meta(tz=True)] = datetime(2026, 1, 1, tzinfo=UTC)
    """Date of time 0 in the log. Fixed, so that a seed gives the same bytes; in real time the clock gives the date."""
    title: str = ""
    sync_hz: Annotated[float, Meta(gt=0.0, le=10_000.0)] | None = None
    """Without it there is no SYNC."""
    bit_rate: Literal[1_000_000, 800_000, 500_000, 250_000, 125_000, 50_000, 20_000, 10_000] = 1_000_000
    """For the bus load in `run --explain`."""
    seed: Annotated[int, Meta(ge=0)] = 1
    loads: tuple[Load, ...] = ()
    noise: Noise | None = None
    front_end: FrontEnd | None = None
    dynamics: Dynamics | None = None
    slit: Slit | None = None
    faults: tuple[Fault, ...] = ()
    outputs: Outputs = Outputs()
    bus: Bus | None = None
    expect: tuple[Expect, ...] = ()

    @property
    def node_ids(self) -> tuple[int, ...]:
        """All node-ids, in the order of the file."""
        return tuple(node_id for group in self.nodes for node_id in group.ids)

    def group(self, node_id: int) -> Nodes:
        """Return the [[nodes]] table of a node."""
        return next(group for group in self.nodes if node_id in group.ids)

    def load(self, node_id: int) -> LoadHistory | None:
        """Return the load of a node, None if the scene names none."""
        histories = (load.history(node_id) for load in self.loads if not load.nodes or node_id in load.nodes)
        return next((history for history in histories if history is not None), None)
