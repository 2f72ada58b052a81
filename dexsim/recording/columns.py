"""A CSV, JSON or NPZ file with named columns as a recording: time, and command, position, effort ... of each joint.

Columns are named `QUANTITY.JOINT`, `JOINT.QUANTITY`, `QUANTITY_JOINT`, `JOINT_QUANTITY` (also with / : or a blank
between), or `QUANTITY` alone where there is one joint; a unit may follow: `position.elbow [deg]`, `elbow_position_deg`,
`time_ms`. An NPZ file may hold arrays [T, J] with `joint_names`, a JSON file a list of mappings (or one a line), or
lists by name. `remap.QUANTITY.JOINT=COLUMN` (`remap.time=COLUMN`) names columns that are called otherwise. A trajectory
controller's columns (`desired.positions[0]`, `actual.positions[0]`) are known, and a table with a column of joint names
and one joint a line. Times may be dates (ISO 8601), numbers may have a decimal comma.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import files
from dexsim.errors import UserError
from dexsim.recording import schema, units
from dexsim.recording.schema import Finding, note
from dexsim.recording.units import ALONG, UNITS

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".log", ".npz", ".json", ".jsonl")
EPOCHS = {"ms": 1e11, "us": 1e14, "ns": 1e17}
"""From where on a time since 1970 is in a unit: 1973, and for 3000 years on."""
_PLACES = ("position", "pos", "angle", "joint_position", "joint_pos", "joint_angle", "dof_pos", "q")


def _both(of: Iterable[str]) -> tuple[str, ...]:
    """Return words of a position before each of `of` and after it: `target_pos`, `pos_target`."""
    return tuple(name for a in of for p in _PLACES for name in (f"{a}_{p}", f"{p}_{a}"))


_SEEN = ("measured", "meas", "present", "actual", "current", "feedback", "state")
_ASKED = ("command", "cmd", "commanded", "target", "setpoint", "reference", "ref", "desired", "des", "goal")
QUANTITIES: dict[str, tuple[str, ...]] = {
    "time": ("time", "timestamp", "stamp", "t", "ts", "host_time", "date", "datetime", "zeit", "datum", "temps",
             "tiempo"),
    "command": (*(x for x in _ASKED if x not in ("ref", "des")), *_both(_ASKED), "target_value", "action", "soll"),
    "position": ("measured", "measured_value", "actual", "present", "feedback", "encoder", "qpos", "observation", "ist",
                 *_PLACES, *_both(_SEEN)),
    "velocity": ("velocity", "vel", "speed", "present_velocity", "qd", "dq", "qvel", "dof_vel"),
    "effort": ("effort", "torque", "tau", "current", "present_current", "motor_current", "motor_torque", "moment",
               "drehmoment", "strom"),
    "temperature": ("temperature", "temp", "present_temperature"),
    "duty": ("duty", "pwm", "duty_cycle", "present_pwm"),
    "enabled": ("enabled", "enable", "torque_enable", "torque_enabled"),
    "supply_voltage": ("supply_voltage", "supply", "voltage", "bus_voltage", "input_voltage", "input_volts"),
}
"""Quantity -> the names that columns may give it."""
_WORDS = sorted(((w, q) for q, words in QUANTITIES.items() for w in words), key=lambda x: -len(x[0]))


def _patterns(word: str) -> tuple[re.Pattern[str], ...]:
    """Return a column that is a word alone, that begins with it, and that ends with it, the joint beside it."""
    inner = r"[\s_-]*".join(map(re.escape, word.split("_"))) + ("s?" if len(word) > 3 else "")
    # one letter is a quantity only beside a mark no word has inside
    between = r"[\s./:\[\](){}_-]+" if len(word) > 1 else r"[./:\[(]+"
    forms = rf"[_\W]*{inner}[_\W]*", rf"\W*{inner}{between}(.+?)[\])}}]*", rf"\W*(.+?){between}{inner}[\])}}]*"
    return tuple(re.compile(form, re.I) for form in forms)


_PATTERNS = {(w, q): _patterns(w) for w, q in _WORDS}
_TIME_FIRST = dict(sorted(_PATTERNS.items(), key=lambda x: x[0][1] != "time"))
_CURRENT = ("current", "present_current", "motor_current", "strom")
_CLOCKS = ("elapsed", "epoch", "timestamp", "time", "stamp", "datetime", "date")
"""Words in the name of a column that may be a time where none is called so."""
_NAMED = ("joint", "joint_name", "name", "motor", "motor_name", "servo", "joint_id", "motor_id", "servo_id")
"""Columns that say which joint a line is of."""
_NOT_POSITIONS = {w for q in ("velocity", "effort", "duty") for w in QUANTITIES[q]} | {"force", "acceleration"}
_OTHER = re.compile(
    rf"({'|'.join((*_ASKED, *_SEEN))})[\s_.]+({'|'.join(sorted(_NOT_POSITIONS, key=len, reverse=True))})([^a-z].*)?",
    re.I,
)
"""A target of another kind than a position, or another measured value."""
_OWN = ("ticks", "counts", "raw", "register", "registers", "value", "abs", "filtered")
"""Ends of a column's name that say no more than that its numbers are the drive's own."""
_CLOCK_STEP = 0.5  # s between samples from which on a time without a unit is not believed to be in seconds


@dataclass
class Table:
    """A file's columns by quantity and joint, in SI units: time [T] s by topic, value[quantity][joint] [T].

    meta: what the columns themselves state (effort_is); start_ns: host time of t = 0; findings: what was assumed or
    left out; unnamed: whether no column names the one joint; si: (quantity, joint) in SI units, by their own unit;
    reported: by quantity and joint, which lines tell of it (all where it is not there); arrays [T, ...]: of other
    topics; ranges: the unit along its range that a joint's columns name."""

    joints: list[str]
    time: dict[str, np.ndarray]
    value: dict[str, dict[str, np.ndarray]]
    meta: dict[str, str]
    start_ns: int
    findings: list[Finding] = field(default_factory=list)
    unnamed: bool = False
    si: set[tuple[str, str]] = field(default_factory=set)
    reported: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    ranges: dict[str, str] = field(default_factory=dict)

    def carried(self, quantity: str) -> np.ndarray | None:
        """Return [T, J] of which joints each of the quantity's samples tells; None: of all."""
        if quantity not in self.reported:
            return None
        lines = len(self.time[quantity])
        out = np.stack([self.reported[quantity].get(j, np.ones(lines, bool)) for j in self.joints], 1)
        return out[self._any(quantity)]

    def _any(self, quantity: str) -> np.ndarray:
        columns = self.value.get(quantity, {})
        return np.any([np.isfinite(columns[j]) for j in self.joints if j in columns], axis=0)

    def samples(self, quantity: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (t [T] s, value [T, J]) of one quantity, rows without any number left out."""
        t, columns = self.time[quantity], self.value.get(quantity, {})
        if not columns:
            return t[:0], np.zeros((0, 0))
        rows = np.stack([columns.get(j, np.full(len(t), np.nan)) for j in self.joints], 1)
        keep = self._any(quantity)
        return t[keep], rows[keep]


def read_table(path: Path, remap: Mapping[str, str], meta: Mapping[str, str], time_unit: str = "") -> Table:
    """Return the table in a CSV, TSV or NPZ file. remap: see the module, and our joint name -> theirs (left to the
    caller).

    meta: what is stated of it; time_unit: of a time without a unit of its own. Raises UserError naming what is
    missing."""
    kinds = {".npz": _npz, ".json": _json, ".jsonl": _json}
    raw, findings = kinds.get(path.suffix.lower(), _csv)(path)
    return of_columns(path, raw, findings, remap, meta, time_unit)


def of_columns(
    path: Path, raw: Mapping[str, Any], findings: list[Finding], remap: Mapping[str, str], meta: Mapping[str, str],
    time_unit: str = "",
) -> Table:  # fmt: skip
    """Return the table in columns by name: numbers [T], or texts [T] (of a text file) that only the columns' names tell
    how to read."""
    named = {k: v for k, v in remap.items() if k.split(".")[0] in QUANTITIES}
    if not raw:
        raise UserError(f"recording {path}: holds no column of numbers")
    raw = _lines_of_joints(_stamped(raw))
    roles, said = _roles(path, list(raw), named), _names_in(raw)
    raw, reported = _numbers(path, raw, roles, findings, set(named.values()))
    roles = {c: r for c, r in roles.items() if c in raw}
    if not any(r[0] == "time" for r in roles.values()):
        roles |= _some_clock(raw, roles, findings)
    if not any(r[0] == "time" for r in roles.values()) and meta.get("rate"):
        rate = float(schema.numbers(meta["rate"], 1, "rate", str(path))[0])
        raw["time"], roles["time"] = np.arange(len(next(iter(raw.values())))) / rate, ("time", "", "s", "time")
    found: dict[str, dict[str, np.ndarray]] = {}
    joints: list[str] = []
    effort: set[str] = set()
    si: set[tuple[str, str]] = set()
    along: dict[str, dict[str, str]] = {}
    of = schema.joint_names(meta.get("joint_names", "")) or said
    listed = {j for q, j, _, _ in roles.values() if q not in ("time", "supply_voltage") and j}
    place = lambda x: x.removeprefix("joint").removeprefix("_")  # noqa: E731
    if of and not listed & set(of) and all(place(x).isdecimal() and int(place(x)) < len(of) for x in listed):
        roles = {c: (q, of[int(place(j))] if j and q != "time" else j, u, w) for c, (q, j, u, w) in roles.items()}
    for column, (quantity, joint, unit, word) in roles.items():
        if joint in found.get(quantity, {}):
            other = next(c for c, r in roles.items() if r[:2] == (quantity, joint))
            raise UserError(
                f"recording {path}: columns '{other}' and '{column}' are both {quantity}"
                f"{' of ' + joint if joint else ''}; say which with "
                f"remap.{quantity}{'.' + joint if joint else ''}=COLUMN"
            )
        if quantity == "effort":
            torque = "torque_Nm" if word != "effort" or unit else ""
            effort.add("current_A" if word in _CURRENT or unit in ("a", "ma") else torque)
        scale = 1.0
        if quantity == "time" and not unit and not time_unit:
            unit = _epoch(raw[column])
            if unit:
                text = f"'{column}' counts {unit} since 1970, by its values (say otherwise with units.time=)"
                findings.append(note("unit", text))
                roles[column] = (quantity, joint, unit, word)
        if quantity in ("command", "position") and unit in ALONG:
            along.setdefault(joint, {})[quantity] = ALONG[unit]
        elif unit or quantity == "time":
            scale = units.parse(unit or time_unit or "s", quantity, f"recording {path}: {column}").scale
            si.add((quantity, joint))
        found.setdefault(quantity, {})[joint] = raw[column] * scale
        if joint and quantity not in ("time", "supply_voltage"):
            joints.append(joint)
    joints = list(dict.fromkeys(joints))
    unnamed = {q for q, c in found.items() if "" in c and q not in ("time", "supply_voltage")}
    nameless = bool(unnamed) and not joints
    if nameless:
        joints = ["joint"]
    for q in unnamed:
        if len(joints) > 1:
            raise UserError(
                f"recording {path}: column '{_column(roles, q, '')}' names no joint, and there are {len(joints)}"
                f" ({', '.join(joints)}); say whose it is with remap.{q}.JOINT='{_column(roles, q, '')}'"
            )
        found[q] = {joints[0]: found[q].pop("")} | found[q]
        si |= {(q, joints[0])} if (q, "") in si else set()
    if not {"position", "command"} & set(found):
        raise UserError(
            f"recording {path}: no column of position or command; columns: {_list(raw)}. Name them like "
            "'position.elbow', or say which with remap.position.JOINT=COLUMN"
        )
    unused = [c for c in raw if c not in roles]
    if unused:
        findings.append(note("topic", f"columns that are not read: {_list(unused)}", "info", count=len(unused)))
    stated = {"effort_is": effort.pop()} if len(effort) == 1 and "" not in effort else {}
    if len(effort) > 1:
        raise UserError(
            f"recording {path}: effort is a current in one column and a torque in another; keep one of them with "
            "remap.effort.JOINT=COLUMN"
        )
    time, start = _clock(path, found, roles, time_unit, list(raw))
    value = {q: c for q, c in found.items() if q != "time"}
    lines: dict[str, dict[str, np.ndarray]] = {}
    for column, on in reported.items():
        quantity, joint = roles[column][:2]
        lines.setdefault(quantity, {})[joint or joints[0]] = on
    ranges = {}
    for joint, units_ in along.items():
        if len(units_) == sum(joint in value.get(q, {}) or not joint for q in ("command", "position") if q in value):
            ranges[joint or joints[0]] = units_.popitem()[1]
    return Table(joints, time, value, stated, start, findings, nameless, si, lines, ranges=ranges)


def _stamped(raw: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return columns as they are, seconds and nanoseconds of one stamp as one time."""
    for column in raw if "time" not in raw else ():
        found = re.fullmatch(r"(|.*[._])secs?", column)
        if found is None:
            continue
        rest = next((c for x in ("nanosec", "nsec", "nsecs", "nanosecs") if (c := found[1] + x) in raw), None)
        if rest is not None:
            whole, part = (_floats(x)[0] if isinstance(x, list) else np.asarray(x) for x in (raw[column], raw[rest]))
            return {"time": whole + 1e-9 * part} | {k: v for k, v in raw.items() if k not in (column, rest)}
    return raw


def _names_in(raw: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of joints that stand in columns `name.0`, `name.1` ..., as messages have them, the same in all lines."""
    for word in ("name", "names", "joint_names"):
        forms = ("{}.{}", "field.{}{}")  # the latter of `rostopic echo -p`
        columns = [raw[c] for form in forms for k in range(len(raw)) if (c := form.format(word, k)) in raw]
        if columns and all(isinstance(x, list) and x[0].strip() and len(set(x)) == 1 for x in columns):
            return tuple(x[0].strip() for x in columns)
    return ()


def _lines_of_joints(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return columns as they are; where a column says which joint each line is of, one for each of its joints, empty in
    the lines of others."""
    which = next((c for c in raw if c.lower().strip() in _NAMED and isinstance(raw[c], list)), None)
    if which is None:
        return dict(raw)
    names = [x.strip() for x in raw[which]]
    joints = dict.fromkeys(x for x in names if x)
    if not 1 <= len(joints) <= len(names) / 5 or any(_role(c) and _role(c)[1] for c in raw if c != which):  # type: ignore[index]
        return dict(raw)
    out: dict[str, Any] = {}
    for column, cells in raw.items():
        role = _role(column)
        if column == which:
            continue
        if role is None or role[0] in ("time", "supply_voltage"):
            out[column] = cells
        else:
            unit = f" [{role[2]}]" if role[2] else ""
            for j in joints:
                out[f"{role[3]}.{j}{unit}"] = [x if n == j else "" for x, n in zip(cells, names, strict=True)]
    return out


def _numbers(
    path: Path, raw: Mapping[str, Any], roles: Mapping[str, tuple[str, str, str, str]], findings: list[Finding],
    named: set[str],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:  # fmt: skip
    """Return (columns as numbers, those without any left out; of columns with empty places, where there is a value
    [T]). Texts that are none are found, but in columns that no role asks for. named: columns that the user named."""
    out: dict[str, np.ndarray] = {}
    reported: dict[str, np.ndarray] = {}
    words, example = 0, ""
    for column, cells in raw.items():
        if not isinstance(cells, list):
            out[column] = np.asarray(cells, float)
            continue
        clock = column in roles and roles[column][0] == "time"
        values, bad = _floats(cells)
        if clock and np.isnan(values).all():
            values, bad = _dates(cells)
            if np.isnan(values).all():
                raise UserError(
                    f"recording {path}: time '{cells[0][:40]}' in column '{column}' is neither a number nor a date as "
                    "ISO 8601 writes it (2026-03-03T17:37:58.123)"
                )
        if np.isnan(values).all():
            if column in named and any(x.strip() for x in cells):
                raise UserError(
                    f"recording {path}: column '{column}' holds no numbers ('{cells[0][:40]}'); name another with "
                    f"remap.{roles[column][0]}=COLUMN"
                )
            continue
        out[column] = values
        if column in roles:
            if bad and not words:
                example = next(x for x, v in zip(cells, values, strict=True) if np.isnan(v) and x.strip())
            words += bad
            empty = np.array([not x.strip() for x in cells])
            if empty.any() and not clock:
                reported[column] = ~empty
    if words:
        text = f"{words} entries are not numbers ('{example[:20]}'; a number is like 1.5e-3); taken as missing"
        findings.append(note("unreadable", text, "error", count=words))
    return out, reported


def _some_clock(
    raw: Mapping[str, np.ndarray], roles: Mapping[str, Any], findings: list[Finding]
) -> dict[str, tuple[str, str, str, str]]:
    """Return the role of the first column that seems to be a time and never goes back; {} where there is none."""
    for column, x in raw.items():
        name, unit = _unit(column)
        words = re.split(r"[^a-z]+", name.lower())
        if column in roles or not any(w in words for w in _CLOCKS) or len(x) < 2 or not np.isfinite(x).all():
            continue
        if (np.diff(x) >= 0).all() and x[-1] > x[0]:
            text = f"time is read from column '{column}' (say otherwise with remap.time=COLUMN)"
            findings.append(note("topic", text, "info"))
            return {column: ("time", "", unit, "time")}
    return {}


def _roles(path: Path, columns: list[str], named: Mapping[str, str]) -> dict[str, tuple[str, str, str, str]]:
    """Return column -> (quantity, joint or "", unit or "", the word it was known by); columns that say nothing known
    are left out."""
    out: dict[str, tuple[str, str, str, str]] = {}
    for key, column in named.items():
        quantity, _, joint = key.partition(".")
        if column not in columns:
            raise UserError(f"recording {path}: has no column '{column}' (remap.{key}); it has: {_list(columns)}")
        out[column] = (quantity, joint, _unit(column)[1], quantity)
    taken = {r[:2] for r in out.values()}
    for column in columns:
        role = None if column in out else _role(column)
        if role is not None and role[:2] not in taken:
            out[column] = role
    return out


def _role(column: str) -> tuple[str, str, str, str] | None:
    if (controller := _CONTROLLER.search(column)) is not None:
        role, what, joint = controller["role"].lower(), controller["what"].lower(), controller["joint"] or ""
        quantity = {"p": "position", "v": "velocity", "e": "effort"}.get(what[0], "")
        if role in ("desired", "reference"):
            quantity = "command" if quantity == "position" else ""
        return (quantity, joint, "", quantity) if quantity and role not in ("error", "output") else None
    name, unit = _unit(column)
    name = re.sub(r"^/?joint_states/|^field[.](?!header)", "", name)
    name = re.sub(r"^(position|velocity|effort)(\d+)$", r"\1.\2", name)  # of `rostopic echo -p`
    name = re.sub(r"^(.*commands?)[./]data[.\[]+(\d+)\]?$", r"command.\2", name)
    if name.lstrip("/").startswith("joint_commands/"):  # topics as plotting tools write them out
        name = re.sub(r"^/?joint_commands/(.+)/position$", r"command.\1", name)
    name = re.sub(r"^observation[./]state[./]", "", name)  # LeRobot's names
    if (seen := re.fullmatch(r"obs(?:ervation)?s?[./](.+)", name)) is not None:
        name = seen[1] if _known(seen[1]) or re.match(r"q[./]", seen[1]) else f"position.{seen[1]}"
    name = re.sub(r"^action[./](.+?)([./]pos)?$", r"command.\1", name)
    if (other := _OTHER.fullmatch(name)) is not None:  # a target, or a measured value, that is no position
        if other[1].lower() in _ASKED:
            return None
        name = other[2] + (other[3] or "")
    if (clock := re.fullmatch(r"t[_.](\w+)|(\w+)[_.]t", name, re.I)) is not None:  # t_cmd, pos_t
        plain = (clock[1] or clock[2]).lower()
        whose = next((q for q, words in QUANTITIES.items() if q != "time" and plain in words), None)
        if whose or plain == "state":
            return "time", whose or "position", unit, "t"
    for (word, quantity), (alone, *_) in _PATTERNS.items():
        if alone.fullmatch(name):
            return quantity, "", unit, word
    for (word, quantity), (_, first, last) in _TIME_FIRST.items():
        found = first.fullmatch(name) or last.fullmatch(name)
        if found is None:
            continue
        joint = found.group(1)
        if quantity == "time":
            of = next((q for q, words in QUANTITIES.items() if joint.lower() in words), None)
            return ("time", of, unit, word) if of else None
        if (quantity == "command" and joint.lower() in _NOT_POSITIONS) or (  # a target of another kind
            quantity in ("velocity", "effort", "duty") and joint.lower() in QUANTITIES["command"]
        ):
            return None
        return quantity, joint, unit, word
    return None


_CONTROLLER = re.compile(
    r"(?:^|[./_])(?P<role>desired|actual|error|reference|feedback|output)[./_]"
    r"(?P<what>positions?|velocit(?:y|ies)|accelerations?|efforts?)(?:[./_\[]+(?P<joint>[^\]]+?)\]?)?$", re.I
)  # fmt: skip
"""Columns of control_msgs/JointTrajectoryControllerState, old and new."""


def _unit(column: str) -> tuple[str, str]:
    """Return (the name without its unit, the unit in lower case or ""). Of a drive's own numbers the unit is not
    named."""
    bare = re.sub(rf"([\s_.]+|\s*[\[(])({'|'.join(_OWN)})[\])]?(?=$|[./:])", "", column, flags=re.I)
    if bare != column and _known(bare):
        return bare, ""
    known = {u for us in UNITS.values() for u in us} | set(ALONG)
    match = re.search(r"^(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$", column)
    if match and match.group(2) == "1" and not match.group(1).rstrip().lower().endswith(QUANTITIES["duty"]):
        match = None  # the second of an array
    if match and match.group(2).lower() in known and match.group(1).strip():
        return match.group(1), match.group(2).lower()
    match = re.search(r"^(.*[^_\s.])[_\s.]([A-Za-z]+(?:/s|_s)?)$", column)
    if match and match.group(2).lower() in known - {"1", "c", "a", "n", "m", "v", "s"}:
        return match.group(1), match.group(2).lower()
    letter = match and match.group(2) in ("A", "N", "V", "s", "C", "m") and column[match.end(1)] != "."  # a joint's
    if match and letter and _known(match.group(1)):
        return match.group(1), match.group(2).lower()
    # current_mA.elbow
    match = re.search(r"^(.*[A-Za-z])[_\s]?[_\s(\[]([A-Za-z.]+(?:/s|_s)?)[)\]]?([./:\[(].+)$", column)
    if match and match.group(2).lower() in known - {"1", "c", "t"} and _known(match.group(1)):
        return match.group(1) + match.group(3), match.group(2).lower()
    return column, ""


def _known(name: str) -> bool:
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return any(
        plain == w or (len(w) > 1 and (plain.startswith(w + "_") or plain.endswith("_" + w)))
        for ws in QUANTITIES.values()
        for w in ws
    )


def _clock(
    path: Path, found: dict, roles: dict, time_unit: str, columns: list[str]
) -> tuple[dict[str, np.ndarray], int]:
    """Time [s] since the start by quantity, and the start in ns of the epoch (0 where the file counts from zero)."""
    clocks = found.get("time", {})
    if not clocks:
        raise UserError(
            f"recording {path}: no column of time; columns: {_list(columns)}. Say which it is with remap.time=COLUMN, "
            "or meta.rate=HZ"
        )
    if "" not in clocks and "position" in clocks:
        clocks[""] = clocks["position"]
    out, first = {}, np.inf
    for quantity in found:
        if quantity == "time":
            continue
        t = clocks.get(quantity, clocks.get(""))
        if t is None:
            raise UserError(f"recording {path}: no time for {quantity}; name a column 'time' or 'time.{quantity}'")
        for joint, x in found[quantity].items():
            if len(x) != len(t):
                raise UserError(
                    f"recording {path}: {quantity}{' of ' + joint if joint else ''} has {len(x)} values and its time "
                    f"{len(t)}"
                )
        steps = np.diff(t[np.isfinite(t)])
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        unit = any(r[0] == "time" and r[2] for r in roles.values()) or bool(time_unit)
        if step > _CLOCK_STEP and not unit and len(t) > 5:
            raise UserError(
                f"recording {path}: time steps by {step:g}, which seconds hardly do; say its unit with "
                "units.time=s, ms, us or ns"
            )
        out[quantity] = t
        if np.isfinite(t).any():
            first = min(first, float(np.nanmedian(t[:5])) if step else float(np.nanmin(t)), float(t[np.isfinite(t)][0]))
    if not np.isfinite(first):
        raise UserError(f"recording {path}: its time holds no number")
    if abs(first) > 9e9:
        raise UserError(
            f"recording {path}: time begins at {first:.4g} s, beyond any date; say its unit with units.time=s, "
            "ms, us or ns"
        )
    return {q: t - first for q, t in out.items()}, round(first * 1e9) if first > 1e6 else 0


def _epoch(t: np.ndarray) -> str:
    """Return the unit in which a time without one counts from 1970: "" where it may be s, or does not."""
    middle = float(np.nanmedian(np.abs(t))) if np.isfinite(t).any() else 0.0
    return next((u for u, least in EPOCHS.items() if least <= middle < 1000 * least), "")


def _json(path: Path) -> tuple[dict[str, Any], list[Finding]]:
    """Return columns of a JSON file: of its first list of mappings, of a mapping a line, or of lists by name."""
    text = files.text(path, "recording", 1 << 30)
    try:
        found = json.loads(text) if path.suffix.lower() == ".json" else [json.loads(x) for x in text.split("\n") if x]
    except ValueError as error:
        raise UserError(f"recording {path}: is not JSON: {error}") from None
    if isinstance(found, dict):
        rows = next((v for v in found.values() if isinstance(v, list) and v and isinstance(v[0], dict)), None)
        if rows is None:  # lists by name
            size = max((len(v) for v in found.values() if isinstance(v, list)), default=0)
            lists = {k: v for k, v in found.items() if isinstance(v, list) and len(v) == size}
            rows = [dict(zip(lists, x, strict=True)) for x in zip(*lists.values(), strict=True)]
        found = rows
    if not isinstance(found, list) or not found or not all(isinstance(x, dict) for x in found):
        raise UserError(f"recording {path}: holds no list of mappings with numbers by name, nor lists by name")
    flat = [_flat(x) for x in found]
    names = dict.fromkeys(k for row in flat for k in row)
    return {k: ["" if (v := row.get(k)) is None else str(v) for row in flat] for k in names}, []


def _flat(row: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return what is nested in a mapping, by names with points between them; places of a list by their number."""
    out: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, list):
            value = dict(enumerate(value))
        out |= _flat(value, f"{before}{key}.") if isinstance(value, dict) else {f"{before}{key}": value}
    return out


def _csv(path: Path) -> tuple[dict[str, list[str]], list[Finding]]:
    """Return columns of a text file, as texts: separated by commas, semicolons or tabs, a line of names before the
    numbers; lines from # on are left out."""
    text = files.text(path, "recording", 1 << 30, "cp1252")  # as spreadsheets write it
    if "\0" in text:
        raise UserError(f"recording {path}: is no text file of columns")
    lines = text.lstrip("\ufeff").splitlines()
    body = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if body and _numeric(body[0]):  # the names may stand in a comment
        heads = [line.lstrip("# \t") for line in lines if line.lstrip().startswith("#")]
        body = ([heads[-1]] if heads else []) + body
    if len(body) < 2 or _numeric(body[0]):
        raise UserError(
            f"recording {path}: no line of column names before numbers; the first line must name the columns,"
            " e.g. time,command.elbow,position.elbow"
        )
    separator = max(",;\t", key=body[0].count)
    if not body[0].count(separator):  # columns with blanks between them
        body, separator = [" ".join(line.split()) for line in body], " "
    if not body[0].count(separator):
        raise UserError(f"recording {path}: its first line has no comma, semicolon, tab or blank between names")
    rows = list(csv.reader(body, delimiter=separator, skipinitialspace=True))
    names = [n.strip() for n in rows[0]]
    twice = next((n for i, n in enumerate(names) if n and n in names[:i]), None)
    if twice:
        raise UserError(f"recording {path}: two columns are called '{twice}'; give each its own name")
    again = [r for r in rows[1:] if [x.strip() for x in r] == names]
    rows = rows[:1] + [r for r in rows[1:] if [x.strip() for x in r] != names]
    bad = sum(len(r) != len(names) for r in rows[1:])
    rows = [r for r in rows[1:] if len(r) == len(names)]
    findings = []
    if again:
        text = f"{len(again)} lines name the columns once more: the logger was started again"
        findings.append(note("malformed", text, count=len(again)))
    if bad:
        text = f"{bad} lines have not as many values as there are names; left out"
        findings.append(note("malformed", text, "error", count=bad))
    return {name: [r[k] for r in rows] for k, name in enumerate(names) if name}, findings


def _floats(cells: list[str]) -> tuple[np.ndarray, int]:
    """(numbers, NaN where there is none; how many entries are something else)."""
    try:
        return np.array(cells, dtype=float), 0
    except ValueError:
        pass
    out, bad = np.full(len(cells), np.nan), 0
    for i, cell in enumerate(cells):
        cell = cell.strip().lower()
        if cell in ("", "nan", "null", "none", "na", "n/a"):
            continue
        try:
            out[i] = {"true": 1.0, "false": 0.0}.get(cell) if cell in ("true", "false") else float(_point(cell))
        except ValueError:
            bad += 1
    return out, bad


def _point(cell: str) -> str:
    """Return a number with a decimal comma as one with a point; thousands may be set apart by points."""
    if cell.count(",") != 1:
        return cell
    whole, rest = cell.split(",")
    return (whole.replace(".", "") if re.fullmatch(r"[-+]?\d{1,3}(\.\d{3})+", whole) else whole) + "." + rest


def _dates(cells: list[str]) -> tuple[np.ndarray, int]:
    """Return (s since 1970, or of the day where only hours are given, NaN where there is none; how many entries are
    something else)."""
    out, bad = np.full(len(cells), np.nan), 0
    for i, cell in enumerate(cells):
        text = cell.strip().replace(",", ".")
        if (day := re.match(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T]+", text)) is not None:
            text = f"{day[3]}-{int(day[2]):02d}-{int(day[1]):02d}T{text[day.end() :]}"
        try:
            if re.match(r"\d{1,2}:\d\d(:|$)", text):
                parts = [float(x) for x in text.split(":")]
                out[i] = 3600 * parts[0] + 60 * parts[1] + (parts[2] if len(parts) > 2 else 0.0)
            else:
                at = datetime.fromisoformat(text)
                out[i] = (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            bad += bool(text)
    return out, bad


def _numeric(line: str) -> bool:
    cells = [c for c in re.split(r"[,;\s]", line) if c.strip()]
    return bool(cells) and not np.isnan(_floats(cells)[0]).all() and _floats(cells)[1] == 0


def _npz(path: Path) -> tuple[dict[str, np.ndarray], list[Finding]]:
    """Return columns of a NumPy archive: arrays [T], or [T, J] with `joint_names` [J]. Nothing pickled is read."""
    try:
        arrays = files.arrays(path)
    except ValueError as error:
        fix = ": cut it into several files" if "unpacks" in str(error) else ""
        fix = "; names as text: np.array(names, dtype=str)" if "no objects" in str(error) else fix
        raise UserError(f"recording {path}: is not an NPZ file that can be read: {error}{fix}") from None
    named = [k for k in ("joint_names", "joints", "names") if k in arrays and arrays[k].dtype.kind in "US"]
    names = arrays.pop(named[0]) if named else None
    out: dict[str, np.ndarray] = {}
    fields = {f"{k}.{n}": x[n] for k, x in arrays.items() for n in x.dtype.names or ()}  # of arrays of records
    if fields and len({k.split(".")[0] for k in fields}) == 1:
        fields = {k.partition(".")[2]: x for k, x in fields.items()}
    arrays |= fields
    length = max((len(x) for x in arrays.values() if x.ndim and x.dtype.kind in "fiu"), default=0)
    step = {"dt": 1.0, "period": 1.0, "fps": -1.0, "rate": -1.0, "hz": -1.0, "frequency": -1.0}
    for key in [k for k in step if k in arrays and arrays[k].size == 1 and arrays[k].dtype.kind in "fiu"]:
        value = float(arrays.pop(key).ravel()[0])
        if value > 0 and "time" not in arrays and "t" not in arrays:
            out["time"] = np.arange(length) * (value if step[key] > 0 else 1 / value)
    for key, x in arrays.items():
        if x.dtype.kind not in "fiub":
            continue
        if x.ndim == 2 and 1 in x.shape and names is None:
            x = x.ravel()
        if x.ndim == 1 and x.size:
            out[key] = x.astype(float)
        elif x.ndim == 2 and x.shape[1] and x.shape[0]:
            labels = [f"joint{j}" for j in range(x.shape[1])] if names is None else [str(n) for n in np.ravel(names)]
            if len(labels) != x.shape[1]:
                raise UserError(
                    f"recording {path}: '{key}' has {x.shape[1]} columns, but joint_names has {len(labels)}"
                )
            name, unit = _unit(key)
            form = "{}.{} [" + unit + "]" if unit else "{}.{}"
            out |= {form.format(name, label): x[:, j].astype(float) for j, label in enumerate(labels)}
    return out, []


def _column(roles: dict, quantity: str, joint: str) -> str:
    return next(c for c, r in roles.items() if r[:2] == (quantity, joint))


def _list(names: Iterable[str], most: int = 12) -> str:
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "") or "none"
